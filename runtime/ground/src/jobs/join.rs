//! All cells together: the global model, column by column, in the memory of a column of one cell.

use std::path::Path;

use models::formats::model::{ModelHeader, write_columns};
use models::ground_cell::CellKey;
use models::light::PictureLight;

use super::cell::Head;
use crate::AggregateError;
use crate::block;
use crate::plan::{Hash, Plan, cell_name};
use crate::store::{Store, StoreError};

/// Missing cells that are named.
const NAMED: usize = 8;

/// The global model.
#[derive(Debug)]
pub struct Joined {
    /// Its header.
    pub header: ModelHeader,
    /// Its Gaussians.
    pub gaussians: usize,
    /// Content hash of the file.
    pub content: Hash,
    /// What became of each cell, in the order of the plan.
    pub heads: Vec<Head>,
}

/// The header of the global model; `of` gives those of the models, where they go.
///
/// # Errors
/// Errors of `of`.
pub fn header(
    plan: &Plan,
    of: &dyn Fn(usize) -> Result<ModelHeader, AggregateError>,
) -> Result<ModelHeader, AggregateError> {
    let (mut views, mut lights, mut uneven) = (Vec::new(), Vec::new(), false);
    for index in 0..plan.models.len() {
        let mut model = of(index)?;
        uneven |= !model.lights.is_empty();
        model.lights.resize(model.views.len(), PictureLight::default());
        views.append(&mut model.views);
        lights.append(&mut model.lights);
    }
    if !uneven {
        // None where all of them are even.
        lights.clear();
    }
    let (mission, origin, seed) = (plan.mission.clone(), plan.origin, plan.recipe.seed);
    Ok(ModelHeader { mission, aircraft: "global".into(), origin, views, seed, lights, ..Default::default() })
}

/// As the plan in `store` has the models.
///
/// # Errors
/// The store's; a model's pieces are damaged.
pub fn header_in(store: &Store, plan: &Plan) -> Result<ModelHeader, AggregateError> {
    header(plan, &|index| block::head(store, &plan.models[index].object, &plan.models[index].head))
}

/// Verifies the cells under the names `inputs` (one for each cell of the plan) and writes the global model. `header` has all but the
/// steps.
///
/// # Errors
/// Cells are missing; one that is damaged is removed and counts as missing. The store's, or the file cannot be written.
pub fn join(
    store: &Store,
    plan: &Plan,
    inputs: &[Hash],
    mut header: ModelHeader,
    path: &Path,
) -> Result<Joined, AggregateError> {
    let (mut heads, mut missing) = (Vec::with_capacity(inputs.len()), Vec::new());
    for (cell, input) in plan.cells.iter().zip(inputs) {
        match sound(store, plan, input)? {
            Some(head) => heads.push(head),
            None => missing.push(cell.key),
        }
    }
    if !missing.is_empty() {
        return Err(missing_of(&missing, plan));
    }
    header.steps = heads.iter().map(|h| u64::from(h.report.learnt.steps)).sum();
    let gaussians = heads.iter().map(|h| h.count).sum::<u64>() as usize;
    let mut spoilt = None;
    let written = write_columns(path, &header, gaussians, plan.sh_degree, &mut |column, out| {
        for (i, (head, input)) in heads.iter().zip(inputs).enumerate() {
            match head.column(store, input, column) {
                Ok(bytes) => out.write_all(&bytes)?,
                Err(e) => {
                    let line = e.to_string();
                    spoilt = Some((i, e));
                    return Err(std::io::Error::other(line));
                }
            }
        }
        Ok(())
    });
    match (written, spoilt) {
        (Ok(content), _) => Ok(Joined { header, gaussians, content, heads }),
        (Err(_), Some((i, StoreError::Damaged { .. }))) => {
            store.remove(&cell_name(&inputs[i]))?;
            Err(missing_of(&[plan.cells[i].key], plan))
        }
        (Err(_), Some((_, e))) => Err(e.into()),
        (Err(e), None) => Err(e.into()),
    }
}

/// The head of a cell that can be used; one that cannot is removed.
///
/// # Errors
/// The store's.
pub fn sound(store: &Store, plan: &Plan, input: &Hash) -> Result<Option<Head>, AggregateError> {
    match Head::read(store, input) {
        Ok(head) if head.as_ref().is_none_or(|h| h.sh_degree == plan.sh_degree) => Ok(head),
        Ok(_) | Err(StoreError::Damaged { .. }) => {
            tracing::warn!("{}: is damaged and was removed", cell_name(input));
            store.remove(&cell_name(input))?;
            Ok(None)
        }
        Err(e) => Err(e.into()),
    }
}

/// Which cells of the plan are not there (any more), and are to be made.
///
/// # Errors
/// The store's.
pub fn missing(store: &Store, plan: &Plan, inputs: &[Hash]) -> Result<Vec<usize>, AggregateError> {
    let mut missing = Vec::new();
    for (i, input) in inputs.iter().enumerate() {
        if sound(store, plan, input)?.is_none() {
            missing.push(i);
        }
    }
    Ok(missing)
}

fn missing_of(keys: &[CellKey], plan: &Plan) -> AggregateError {
    let named: Vec<String> = keys.iter().take(NAMED).map(CellKey::to_string).collect();
    let more = if keys.len() > NAMED { format!(" and {} more", keys.len() - NAMED) } else { String::new() };
    AggregateError::MissingCells { named: named.join(", ") + &more, count: keys.len(), of: plan.cells.len() }
}
