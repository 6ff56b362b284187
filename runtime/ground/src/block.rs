//! What a job reads of the models: their pieces in its square and the eight around it, each checked by its hash.

use models::cloud::GaussianCloud;
use models::formats::model::{ModelHeader, columns, decode_header};

use super::AggregateError;
use super::plan::{Hash, Inputs, Piece, Read, model_name};
use super::store::{Store, StoreError};

/// The models around one square.
pub struct Block<'a> {
    /// All that the job depends on.
    pub inputs: &'a Inputs,
    store: &'a Store,
}

/// Bytes of so many Gaussians as columns.
pub fn column_bytes(sh_degree: u8, rows: u64) -> u64 {
    4 * rows * columns::floats(sh_degree).iter().sum::<usize>() as u64
}

impl<'a> Block<'a> {
    /// Of what lies in `store`.
    pub fn new(inputs: &'a Inputs, store: &'a Store) -> Self {
        Self { inputs, store }
    }

    /// Gaussians of a model around the square.
    pub fn rows(&self, model: usize) -> usize {
        self.inputs.models[model].pieces.iter().map(|p| p.rows as usize).sum()
    }

    /// A model's pieces, one at a time, in the order of keys.
    pub fn pieces(&self, model: usize) -> impl Iterator<Item = Result<GaussianCloud, AggregateError>> + '_ {
        let model = &self.inputs.models[model];
        model.pieces.iter().map(move |piece| self.piece(model, piece))
    }

    fn piece(&self, model: &Read, piece: &Piece) -> Result<GaussianCloud, AggregateError> {
        let bytes = column_bytes(model.sh_degree, piece.rows.into());
        let bytes = read(self.store, &model.object, piece.from, bytes, &piece.hash)?;
        let cloud = columns::read_cloud(&mut bytes.as_slice(), model.sh_degree, piece.rows as usize);
        Ok(cloud.map_err(|_| damaged(&model.object))?)
    }

    /// All of a model's pieces.
    ///
    /// # Errors
    /// The store's; a piece is damaged.
    pub fn cloud(&self, model: usize) -> Result<GaussianCloud, AggregateError> {
        let mut all = GaussianCloud::with_capacity(self.inputs.models[model].sh_degree, self.rows(model));
        for piece in self.pieces(model) {
            all.extend(&piece?);
        }
        Ok(all)
    }

    /// What a model says about itself.
    ///
    /// # Errors
    /// The store's; it is damaged.
    pub fn head(&self, model: usize) -> Result<ModelHeader, AggregateError> {
        let model = &self.inputs.models[model];
        head(self.store, &model.object, &model.head)
    }
}

/// What the model in this object says about itself.
///
/// # Errors
/// The store's; it is damaged.
pub fn head(store: &Store, object: &Hash, (bytes, hash): &(u64, Hash)) -> Result<ModelHeader, AggregateError> {
    let bytes = read(store, object, 0, *bytes, hash)?;
    Ok(decode_header(model_name(object).as_ref(), &bytes)?)
}

fn read(store: &Store, object: &Hash, from: u64, bytes: u64, hash: &Hash) -> Result<Vec<u8>, AggregateError> {
    let bytes = store.range(&model_name(object), from, bytes)?;
    match blake3::hash(&bytes).as_bytes() == hash {
        true => Ok(bytes),
        false => Err(damaged(object).into()),
    }
}

fn damaged(object: &Hash) -> StoreError {
    StoreError::Damaged { name: model_name(object), what: "its content does not match its checksum" }
}
