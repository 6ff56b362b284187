//! The questions of `dgtr init` on a terminal: what a mission file cannot be guessed without. Each says what an empty answer means.

use std::io::{self, BufRead, Read, Write};

/// Longest answer that is read, bytes: some hundred aircraft.
const LONGEST: u64 = 1 << 14;
/// So many answers in a row that cannot be read are no person's.
const PATIENCE: u32 = 20;

/// Somebody to be asked.
pub(super) struct Terminal<I, O> {
    answers: I,
    questions: O,
}

impl<I: BufRead, O: Write> Terminal<I, O> {
    /// Questions are written to one end, answers are read from the other.
    pub(super) fn new(answers: I, questions: O) -> Self {
        Self { answers, questions }
    }

    /// Asks `question` until `read` takes the answer; an empty one is `otherwise`.
    ///
    /// # Errors
    /// Nobody answers (any more), or with nothing that can be read.
    pub(super) fn ask<T>(
        &mut self,
        question: &str,
        otherwise: &str,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> io::Result<T> {
        for _ in 0..PATIENCE {
            write!(self.questions, "{question} [{otherwise}]: ")?;
            self.questions.flush()?;
            let mut answer = String::new();
            if self.answers.by_ref().take(LONGEST).read_line(&mut answer)? == 0 {
                return Err(io::ErrorKind::UnexpectedEof.into());
            }
            let answer = answer.trim();
            match read(if answer.is_empty() { otherwise } else { answer }) {
                Ok(value) => return Ok(value),
                Err(why) => writeln!(self.questions, "  {why}")?,
            }
        }
        Err(io::ErrorKind::InvalidInput.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(answers: &str) -> (io::Result<u8>, String) {
        let mut said = Vec::new();
        let read = |text: &str| text.parse().map_err(|_| "give a small number".to_owned());
        let answer = Terminal::new(answers.as_bytes(), &mut said).ask("How many", "7", read);
        (answer, String::from_utf8(said).expect("text"))
    }

    #[test]
    fn an_empty_answer_is_the_one_in_brackets_and_a_wrong_one_is_asked_for_again() {
        assert_eq!(asked("\n").0.expect("read"), 7);
        let (answer, said) = asked("many\n 300 \n12\n");
        assert_eq!(answer.expect("read"), 12);
        assert_eq!(said, "How many [7]: ".to_owned() + &"  give a small number\nHow many [7]: ".repeat(2));
    }

    #[test]
    fn nobody_is_asked_for_ever() {
        assert_eq!(asked("").0.expect_err("nobody").kind(), io::ErrorKind::UnexpectedEof);
        assert_eq!(asked(&"x\n".repeat(99)).0.expect_err("nothing").kind(), io::ErrorKind::InvalidInput);
        assert!(asked(&"9".repeat(1 << 20)).0.is_err(), "a line without an end");
    }
}
