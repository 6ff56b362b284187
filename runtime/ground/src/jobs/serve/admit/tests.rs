use super::*;
use crate::jobs::serve::tests::mission;
use crate::member::Member;
use crate::testing::{carpet, merged, model, nadir};

fn written(dir: &Path, name: &str, edit: impl FnOnce(&mut LocalModel)) -> std::path::PathBuf {
    let mut local = model(name, &[], carpet([-40.0, -20.0], [40.0, 20.0], 1.0));
    edit(&mut local);
    let path = dir.join(format!("{name}.dgtr"));
    models::formats::model::write(&path, &local.header, &local.cloud).expect("write");
    path
}

/// One aircraft claimed ten kilometres in every direction, and the other one kept 0 of its 3,200 Gaussians.
#[test]
fn the_missions_regions_win_over_what_models_claim() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mission = mission(dir.path());
    let far = [[-1e4, -1e4], [1e4, -1e4], [1e4, 1e4], [-1e4, 1e4]];
    let west = written(dir.path(), "west", |m| m.header.region = far.to_vec());
    let east = written(dir.path(), "east", |_| {});
    let mut models =
        [admit(&mission, "west", &west), admit(&mission, "east", &east)].map(|m| Member::of(m.expect("admitted")));
    let kept = merged(&mut models, usize::MAX).kept;
    assert_eq!((kept[0].own, kept[1].own), (1600, 1600));
}

#[test]
fn what_does_not_belong_to_aircraft_and_mission_is_refused_with_its_reason() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mission = mission(dir.path());
    let refused = |aircraft: &str, edit: fn(&mut LocalModel)| {
        let path = written(dir.path(), "west", edit);
        admit(&mission, aircraft, &path).map_or_else(|e| e.to_string(), |_| "admitted".into())
    };
    assert_eq!(refused("west", |m| m.header.views.push(("v".into(), nadir(0.0, 0.0, 30.0)))), "admitted");
    assert!(refused("east", |_| {}).contains("made by \"west\""));
    assert!(refused("west", |m| m.header.mission = "other".into()).contains("mission \"other\""));
    assert!(
        refused("west", |m| m.header.origin = Some(Geodetic { lat_deg: 48.0, lon_deg: 8.0, alt_m: 0.0 }))
            .contains("origin")
    );
    assert!(refused("west", |m| m.cloud.means.iter_mut().for_each(|p| p[0] += 5_000.0)).contains("region"));
    let no_number: fn(&mut LocalModel) = |m| m.cloud.means.iter_mut().for_each(|p| p[0] = f32::NAN);
    assert!(refused("west", no_number).contains("region"));
    assert!(refused("west", |m| _ = m.cloud.retain(|_| false)).contains("region"));
}

#[test]
fn a_rounded_model_that_unpacks_to_more_than_the_ground_takes_is_refused_before_it_is_unpacked() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut mission = mission(dir.path());
    mission.upload.max_model_mib = 1;
    let rounded = |spacing: f64| {
        let local = model("west", &[], carpet([-40.0, -20.0], [40.0, 20.0], spacing));
        let path = dir.path().join("west.dgtr");
        let (disk, rounding) = (Default::default(), Default::default());
        models::formats::model::write_rounded(&disk, &path, &local.header, &local.cloud, &rounding).expect("write");
        assert!(path.metadata().expect("metadata").len() < 1 << 20, "the file itself would do");
        admit(&mission, "west", &path).map_or_else(|e| e.to_string(), |_| "admitted".into())
    };
    assert_eq!(rounded(1.0), "admitted");
    assert!(rounded(0.3).contains("upload.max_model_mib"));
}

/// Such a view ended the ground with a panic, and nobody had a global model.
#[test]
fn a_view_larger_than_the_missions_camera_costs_its_own_model_only() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mission = mission(dir.path());
    let with = |edit: fn(&mut View)| {
        let mut view = nadir(0.0, 0.0, 30.0);
        edit(&mut view);
        let path = written(dir.path(), "west", |m| m.header.views.push(("v".into(), view)));
        admit(&mission, "west", &path).map(drop)
    };
    assert_eq!(with(|_| {}), Ok(()));
    assert!(
        with(|v| v.intrinsics.width = 65).is_err_and(|e| e.to_string().contains("larger than the mission's camera"))
    );
    assert!(with(|v| v.intrinsics = v.intrinsics.resized(6400, 4800)).is_err());
    assert_eq!(with(|v| v.intrinsics = v.intrinsics.resized(32, 24)), Ok(()));
}

/// 20,000 Gaussians over a thousand kilometres, 1.1 MB, made a job and a synced file each.
#[test]
fn a_model_strewn_over_more_ground_than_its_aircraft_can_have_seen_is_refused_before_it_is_merged() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mission = mission(dir.path());
    let all = carpet([-40.0, -20.0], [40.0, 20.0], 1.0).len();
    let strewn = |share: f64, reach: f32| {
        let path = written(dir.path(), "west", |m| {
            let n = m.cloud.len();
            let strewn = (share * n as f64) as usize;
            // A sequence that fills the square evenly (Roberts 2018, R2).
            for (i, mean) in m.cloud.means.iter_mut().enumerate().take(strewn) {
                let along = |step: f64| ((i as f64 * step).fract() * 2.0 - 1.0) as f32 * reach;
                *mean = [along(0.754_877_666), along(0.569_840_291), 0.0];
            }
        });
        admit(&mission, "west", &path)
            .map_or_else(|e| e.to_string(), |m| format!("{} of 100", 100 * m.cloud.len() / all))
    };
    assert_eq!(strewn(0.0, 0.0), "100 of 100");
    assert_eq!(strewn(0.02, 400.0), "100 of 100", "a horizon");
    assert_eq!(strewn(0.5, 1e6), "50 of 100", "false matches far away are left out");
    assert!(strewn(0.9, 1e6).contains("farther from its aircraft's region"), "{}", strewn(0.9, 1e6));
    assert!(strewn(0.9, 10_000.0).contains("farther from its aircraft's region"));
    let mut mission = mission.clone();
    mission.ground.cell_m = 32.0;
    let path = written(dir.path(), "west", |m| {
        for (i, mean) in m.cloud.means.iter_mut().enumerate().skip(1) {
            *mean = [(i % 56) as f32 * 32.0 - 900.0, (i / 56) as f32 * 32.0 - 900.0, 0.0];
        }
    });
    let why = admit(&mission, "west", &path).map_or_else(|e| e.to_string(), |_| "admitted".into());
    assert!(why.contains("strewn over"), "{why}");
}

/// 60,000 views in a header of two megabytes kept the merge busy for hours.
#[test]
fn a_model_with_more_views_than_the_mission_keeps_is_refused() {
    let dir = tempfile::tempdir().expect("temp dir");
    let mut mission = mission(dir.path());
    mission.keyframes.max = 3;
    let with = |views: usize| {
        let view = |i: usize| (format!("v{i}"), nadir(i as f64, 0.0, 30.0));
        let path = written(dir.path(), "west", |m| m.header.views = (0..views).map(view).collect());
        admit(&mission, "west", &path).map_or_else(|e| e.to_string(), |_| "admitted".into())
    };
    assert_eq!(with(3), "admitted");
    assert!(with(4).contains("keyframes.max"), "{}", with(4));
}
