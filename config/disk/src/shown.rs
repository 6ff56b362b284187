//! What a name or a message of somebody else may be within a line that people read.

use std::fmt::{self, Write};

/// `text` on one line, with nothing in it that a terminal obeys.
pub fn escaped(text: &str) -> String {
    let mut line = String::with_capacity(text.len());
    // Writing into a String cannot fail.
    let _ = Escaping::new(&mut line, |c| c.is_control()).write_str(text);
    line
}

/// Passes on what is written to it, and writes out the characters that a terminal would obey as JSON and TOML do: text in one of these
/// stays what it is.
pub struct Escaping<W, F> {
    out: W,
    is_obeyed: F,
}

impl<W: Write, F: Fn(char) -> bool> Escaping<W, F> {
    /// Writes to `out`, escaped where `is_obeyed` holds.
    pub fn new(out: W, is_obeyed: F) -> Self {
        Self { out, is_obeyed }
    }
}

impl<W: Write, F: Fn(char) -> bool> Write for Escaping<W, F> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for part in text.split_inclusive(&self.is_obeyed) {
            match part.chars().next_back().filter(|c| (self.is_obeyed)(*c)) {
                Some(obeyed) => {
                    self.out.write_str(&part[..part.len() - obeyed.len_utf8()])?;
                    match obeyed {
                        '\n' => self.out.write_str("\\n")?,
                        '\r' => self.out.write_str("\\r")?,
                        '\t' => self.out.write_str("\\t")?,
                        other => write!(self.out, "\\u{:04x}", u32::from(other))?,
                    }
                }
                None => self.out.write_str(part)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_that_a_terminal_obeys_and_no_line_end_is_in_a_line() {
        assert_eq!(
            escaped("a\u{1b}[2J\nINFO b\r\u{9b}31m\u{7f}\0 \u{e9}"),
            "a\\u001b[2J\\nINFO b\\r\\u009b31m\\u007f\\u0000 \u{e9}"
        );
        assert_eq!(escaped(""), "");
    }
}
