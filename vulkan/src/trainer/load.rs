//! A scene into the trainer: as a whole, or piece by piece, where it is larger than the host's memory.

mod kept;

pub(crate) use kept::Kept;

use super::parameters::record_of;
use super::{TrainError, Trainer};
use models::cloud::{GaussianCloud, sh_coefficients};

/// Reads a scene from its beginning to its end and gives it away in pieces, whole Gaussians each. It is called as often as the scene has
/// to be looked at and must give the same Gaussians in the same order every time.
pub type Pieces<'a, E> = &'a dyn Fn(&mut dyn FnMut(&GaussianCloud) -> Result<(), E>) -> Result<(), E>;

/// What became of a cloud's Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LoadReport {
    /// Gaussians now trained.
    pub loaded: usize,
    /// Those with numbers that are not finite or a quaternion that cannot be normalised.
    pub dropped_non_finite: usize,
    /// Those beyond the plan's capacity; the least important (opacity × area) made way.
    pub dropped_over_capacity: usize,
}

impl Trainer {
    /// Replaces the Gaussians and starts the schedule anew. Those that are not finite are left out, and so are the least
    /// important ones beyond the plan's capacity.
    ///
    /// # Errors
    /// [`TrainError::Empty`] when nothing remains; [`TrainError::SceneFile`] where they are more than the device holds.
    pub fn load(&mut self, cloud: &GaussianCloud) -> Result<LoadReport, TrainError> {
        self.load_pieces::<TrainError>(&|take| take(cloud))
    }

    /// As [`Trainer::load`] of all pieces in one, of which the host holds one at a time.
    ///
    /// # Errors
    /// As [`Trainer::load`], and those of `pieces`: no Gaussians are there then, where it had begun to replace them.
    pub fn load_pieces<E: From<TrainError>>(&mut self, pieces: Pieces<'_, E>) -> Result<LoadReport, E> {
        let (kept, report) = Kept::new(pieces, self.plan.scene)?;
        if report.loaded == 0 {
            return Err(TrainError::Empty { non_finite: report.dropped_non_finite }.into());
        }
        self.scene.close();
        self.gaussians = 0;
        let degree = self.plan.sh_degree;
        let fill = |cloud: &GaussianCloud, row: usize, record: &mut [u8]| {
            record_of(cloud, row, 3 * sh_coefficients(degree.min(cloud.sh_degree)), record);
        };
        if report.loaded > self.plan.gaussians {
            self.scene.fill(&self.plan, &self.settings, report.loaded, &kept, fill)?;
        } else {
            self.fill_device(report.loaded, &kept, fill)?;
        }
        self.restart();
        Ok(report)
    }

    fn fill_device<E: From<TrainError>>(
        &mut self,
        n: usize,
        kept: &Kept<'_, E>,
        fill: impl Fn(&GaussianCloud, usize, &mut [u8]),
    ) -> Result<(), E> {
        let (mut record, mut to) = (std::mem::take(&mut self.record), 0);
        let done = kept.each(&mut |cloud, rows| {
            for row in rows {
                // A source that gives more than it gave before is stopped before it leaves its place.
                if to == n {
                    return Err(TrainError::SceneChanged.into());
                }
                fill(cloud, *row as usize, &mut record);
                self.parameters.write_record(&mut self.arena, to, &record);
                to += 1;
            }
            Ok(())
        });
        self.record = record;
        done?;
        if to < n {
            return Err(TrainError::SceneChanged.into());
        }
        self.gaussians = n;
        Ok(())
    }
}
