//! A file of lines that grows by whole ones: what a full disk took of a line is taken off again.

use std::io::{self, ErrorKind};

use crate::Output;

/// The open file.
#[derive(Debug)]
pub struct Lines {
    file: Box<dyn Output>,
    /// Bytes behind the last whole line.
    torn: u64,
}

impl Lines {
    pub(crate) fn new(file: Box<dyn Output>, torn: u64) -> Self {
        Self { file, torn }
    }

    /// Writes `line`, which ends as lines do, or nothing of it.
    ///
    /// # Errors
    /// The system's. What of the line is in the file then is taken off now or, where that fails, too, before the next line.
    pub fn write(&mut self, line: &[u8]) -> io::Result<()> {
        self.take_off_what_is_torn()?;
        let mut left = line;
        while !left.is_empty() {
            match self.file.write(left) {
                Ok(0) => return self.torn(ErrorKind::WriteZero.into()),
                Ok(n) => {
                    self.torn += n as u64;
                    left = &left[n..];
                }
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) => return self.torn(e),
            }
        }
        self.torn = 0;
        Ok(())
    }

    fn torn(&mut self, why: io::Error) -> io::Result<()> {
        // What remains is tried again by the next line.
        let _ = self.take_off_what_is_torn();
        Err(why)
    }

    pub(crate) fn take_off_what_is_torn(&mut self) -> io::Result<()> {
        if self.torn > 0 {
            self.file.take_off(self.torn)?;
            self.torn = 0;
        }
        Ok(())
    }

    /// Makes the lines durable.
    ///
    /// # Errors
    /// The system's.
    pub fn sync(&mut self) -> io::Result<()> {
        self.file.sync()
    }
}
