//! A network that the user's settings name: manifest and file are read and the contract is compared once when it is
//! opened, so that a wrong export is refused before a flight and not in it; the session then lives only while it works.

use std::path::Path;

use super::manifest::{Contract, Manifest};
use super::session::NetworkSession;
use super::{OnnxError, network};

/// A checked network without, or with, a session.
#[derive(Debug)]
pub(super) struct NamedNetwork {
    manifest: Manifest,
    bytes: Vec<u8>,
    threads: usize,
    session: Option<((u32, u32), NetworkSession)>,
}

impl NamedNetwork {
    /// Reads a manifest that must follow `contract`, and compares the network with it for pictures of `size`.
    ///
    /// # Errors
    /// A file is missing or damaged, the contract is another, a tensor's name, shape or type does not fit.
    pub fn open(path: &Path, contract: Contract, size: (u32, u32), threads: usize) -> Result<Self, OnnxError> {
        let manifest = Manifest::read(path)?;
        if manifest.contract != contract {
            return Err(OnnxError::Manifest {
                manifest: path.display().to_string(),
                field: "contract",
                reason: format!("is `{}`, needed is `{}`", manifest.contract.name(), contract.name()),
            });
        }
        let bytes = manifest.read_network()?;
        let (w, h) = manifest.input_size(size.0, size.1);
        network::open(&manifest, &bytes, (w, h), threads)?;
        Ok(Self { manifest, bytes, threads, session: None })
    }

    /// What the network promises.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// A session for inputs of a size; another size opens another one.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn at(&mut self, size: (u32, u32)) -> Result<&mut NetworkSession, OnnxError> {
        let session = match self.session.take().filter(|(open, _)| *open == size) {
            Some(session) => session,
            None => (size, network::open(&self.manifest, &self.bytes, size, self.threads)?),
        };
        Ok(&mut self.session.insert(session).1)
    }

    /// Gives the session's memory back.
    pub fn close(&mut self) {
        self.session = None;
    }

    /// What came out is not what the contract promises.
    pub fn broken(&self, tensor: &str, expected: String, found: String) -> OnnxError {
        OnnxError::Contract {
            network: self.manifest.name.clone(),
            contract: self.manifest.contract.name(),
            tensor: format!("output `{tensor}`"),
            expected,
            found,
        }
    }
}
