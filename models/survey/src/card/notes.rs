//! What a user should know about the pictures of a card, in few lines.

/// Pictures by what is to be said of them, so that a thousand of them make one line.
#[derive(Debug, Default)]
pub(crate) struct Notes(Vec<(String, Vec<String>)>);

/// Names spelt out in a line.
const NAMED: usize = 8;

impl Notes {
    /// Notes that `what` is true of the picture `name`.
    pub(crate) fn add(&mut self, what: impl Into<String>, name: impl Into<String>) {
        let (what, name) = (what.into(), name.into());
        match self.0.iter_mut().find(|(w, _)| *w == what) {
            Some((_, names)) => names.push(name),
            None => self.0.push((what, vec![name])),
        }
    }

    pub(crate) fn lines(&self) -> impl Iterator<Item = String> {
        self.0.iter().map(|(what, names)| format!("{}: {what}", name_list(names)))
    }

    pub(crate) fn summary(&self) -> Option<String> {
        let all: Vec<String> = self.lines().collect();
        (!all.is_empty()).then(|| all.join("; "))
    }
}

/// "6 pictures (a, b, c …)", or the name of the only one.
pub fn name_list<S: AsRef<str>>(names: &[S]) -> String {
    match names {
        [one] => one.as_ref().to_owned(),
        _ => {
            let spelt: Vec<&str> = names.iter().take(NAMED).map(AsRef::as_ref).collect();
            let more = if names.len() > NAMED { ", …" } else { "" };
            format!("{} pictures ({}{more})", names.len(), spelt.join(", "))
        }
    }
}
