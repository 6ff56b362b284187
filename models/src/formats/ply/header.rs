//! The header of a PLY file, and its rows as numbers, whether they are binary of either order or text.

use std::io::{BufRead, Read};
use std::path::Path;

use geometry::geodesy::Geodetic;

use super::FormatError;

/// Longest header taken; a 3DGS one has 1.5 KiB.
const MAX_HEADER: u64 = 64 << 10;
/// Most properties of an element, and most elements.
const MAX_PROPERTIES: usize = 256;
const MAX_ELEMENTS: usize = 16;
/// Longest row of text: 24 characters a number.
const MAX_LINE: u64 = 24 * MAX_PROPERTIES as u64;

/// How numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Little,
    Big,
    Text,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    F32,
    F64,
    /// Whole numbers: bytes, and whether they have a sign.
    Whole(usize, bool),
}

impl Kind {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            "char" | "int8" => Self::Whole(1, true),
            "uchar" | "uint8" => Self::Whole(1, false),
            "short" | "int16" => Self::Whole(2, true),
            "ushort" | "uint16" => Self::Whole(2, false),
            "int" | "int32" => Self::Whole(4, true),
            "uint" | "uint32" => Self::Whole(4, false),
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::F64 => 8,
            Self::Whole(n, _) => n,
        }
    }
}

#[derive(Clone, Debug)]
pub(super) struct Property {
    pub name: String,
    pub kind: Kind,
    offset: usize,
}

/// Rows of one kind.
#[derive(Clone, Debug)]
pub(super) struct Element {
    pub name: String,
    pub count: u64,
    pub properties: Vec<Property>,
    /// Has a list, whose rows differ in length.
    has_list: bool,
}

impl Element {
    fn stride(&self) -> usize {
        self.properties.last().map_or(0, |p| p.offset + p.kind.bytes())
    }
}

#[derive(Debug)]
pub(super) struct Header {
    pub encoding: Encoding,
    pub elements: Vec<Element>,
    pub comments: Vec<String>,
    pub bytes: u64,
}

impl Header {
    pub(super) fn element(&self, name: &str) -> Option<&Element> {
        self.elements.iter().find(|e| e.name == name)
    }

    pub(super) fn vertices(&self) -> Option<&Element> {
        self.element("vertex")
    }

    /// Where the file says that its origin is.
    pub(super) fn origin(&self, key: &str) -> Option<Geodetic> {
        self.comments.iter().rev().find_map(|comment| {
            let mut v = comment.strip_prefix(key)?.split_ascii_whitespace().map(|v| v.parse().ok());
            let o = Geodetic { lat_deg: v.next()??, lon_deg: v.next()??, alt_m: v.next()?? };
            o.is_valid().then_some(o)
        })
    }

    /// Refuses rows that a file of `size` bytes cannot hold; those of text have at least two bytes a number.
    pub(super) fn check_size(&self, path: &Path, size: u64) -> Result<(), FormatError> {
        let mut needed = Some(self.bytes);
        for element in &self.elements {
            let row = match self.encoding {
                Encoding::Text => 2 * element.properties.len() as u64,
                _ => element.stride() as u64,
            };
            needed = element.count.checked_mul(row).and_then(|bytes| needed?.checked_add(bytes));
            if needed.is_none_or(|needed| needed > size + 1) {
                return Err(FormatError::Truncated { path: path.to_owned(), at: size, what: "its vertices" });
            }
            if element.name == "vertex" && self.element("chunk").is_none() {
                break;
            }
        }
        Ok(())
    }
}

pub(super) fn read(path: &Path, input: &mut impl BufRead) -> Result<Header, FormatError> {
    let bad = |what: String| FormatError::invalid(path, what);
    let mut header = Header { encoding: Encoding::Little, elements: Vec::new(), comments: Vec::new(), bytes: 0 };
    let mut line = Vec::new();
    for number in 1.. {
        line.clear();
        let left = MAX_HEADER - header.bytes;
        let n =
            input.by_ref().take(left).read_until(b'\n', &mut line).map_err(|e| FormatError::io(path, "reading", e))?;
        header.bytes += n as u64;
        if number == 1 && line.trim_ascii_end() != b"ply" {
            return Err(bad("is not a PLY file (its first line is not \"ply\")".into()));
        }
        if line.last() != Some(&b'\n') {
            return Err(if header.bytes >= MAX_HEADER {
                FormatError::TooLarge {
                    path: path.to_owned(),
                    what: "its header",
                    size: header.bytes,
                    limit: MAX_HEADER,
                }
            } else {
                FormatError::Truncated { path: path.to_owned(), at: header.bytes, what: "its header" }
            });
        }
        let text = String::from_utf8_lossy(&line).into_owned();
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => break,
            ["format", "binary_little_endian", _] => header.encoding = Encoding::Little,
            ["format", "binary_big_endian", _] => header.encoding = Encoding::Big,
            ["format", "ascii", _] => header.encoding = Encoding::Text,
            ["format", other, ..] => return Err(bad(format!("PLY format {other} is not known"))),
            ["element", name, n] => {
                if header.elements.len() == MAX_ELEMENTS {
                    return Err(bad(format!("has more than {MAX_ELEMENTS} elements")));
                }
                let count = n.parse().map_err(|_| bad(format!("line {number}: {n:?} is no number of rows")))?;
                let name = (*name).to_owned();
                header.elements.push(Element { name, count, properties: Vec::new(), has_list: false });
            }
            ["property", "list", ..] => {
                if let Some(element) = header.elements.last_mut() {
                    element.has_list = true;
                }
            }
            ["property", kind, name] => {
                let Some(element) = header.elements.last_mut() else {
                    return Err(bad(format!("line {number}: a property belongs to no element")));
                };
                let Some(kind) = Kind::parse(kind) else {
                    return Err(bad(format!("line {number}: property type {kind} is not supported")));
                };
                if element.properties.len() == MAX_PROPERTIES {
                    return Err(bad(format!("has more than {MAX_PROPERTIES} properties")));
                }
                let offset = element.stride();
                element.properties.push(Property { name: (*name).to_owned(), kind, offset });
            }
            ["comment", ..] => {
                header.comments.push(text.trim_end().trim_start_matches("comment").trim_start().to_owned());
            }
            _ => {}
        }
    }
    Ok(header)
}

/// The rows of an element, one at a time.
pub(super) struct Rows<'a> {
    path: &'a Path,
    element: &'a Element,
    encoding: Encoding,
    input: &'a mut dyn Read,
    left: u64,
    row: Row,
}

/// One row.
#[derive(Default)]
pub(super) struct Row {
    values: Vec<f64>,
    bytes: Vec<u8>,
}

impl Row {
    /// The value of property number `at`.
    pub(super) fn float(&self, at: usize) -> f32 {
        self.values[at] as f32
    }

    /// The value of property number `at` with all its digits.
    pub(super) fn number(&self, at: usize) -> f64 {
        self.values[at]
    }

    /// The value of property number `at` as a whole number.
    pub(super) fn word(&self, at: usize) -> u32 {
        self.values[at] as u32
    }
}

impl<'a> Rows<'a> {
    /// # Errors
    /// The element has lists.
    pub(super) fn new(
        path: &'a Path,
        header: &Header,
        element: &'a Element,
        input: &'a mut dyn Read,
    ) -> Result<Self, FormatError> {
        if element.has_list && element.count > 0 {
            let what = format!("element {} has lists, which cannot be read before the vertices", element.name);
            return Err(FormatError::invalid(path, what));
        }
        // Rows of nothing take no bytes, however many a header claims.
        let left = if element.properties.is_empty() { 0 } else { element.count };
        Ok(Self { path, element, encoding: header.encoding, input, left, row: Row::default() })
    }

    /// The next row; `None` behind the last.
    pub(super) fn next(&mut self) -> Result<Option<&Row>, FormatError> {
        if self.left == 0 {
            return Ok(None);
        }
        self.left -= 1;
        match self.encoding {
            Encoding::Text => self.text()?,
            encoding => self.binary(encoding == Encoding::Big)?,
        }
        Ok(Some(&self.row))
    }

    fn binary(&mut self, is_big: bool) -> Result<(), FormatError> {
        let Row { values, bytes } = &mut self.row;
        bytes.resize(self.element.stride(), 0);
        self.input.read_exact(bytes).map_err(|e| FormatError::io(self.path, "reading", e))?;
        values.clear();
        for property in &self.element.properties {
            let mut word = [0; 8];
            let n = property.kind.bytes();
            let stored = &bytes[property.offset..property.offset + n];
            word[..n].copy_from_slice(stored);
            if is_big {
                word[..n].reverse();
            }
            let whole = u32::from_le_bytes([word[0], word[1], word[2], word[3]]);
            values.push(match property.kind {
                Kind::F32 => f64::from(f32::from_bits(whole)),
                Kind::F64 => f64::from_le_bytes(word),
                Kind::Whole(1, true) => f64::from(whole as u8 as i8),
                Kind::Whole(2, true) => f64::from(whole as u16 as i16),
                Kind::Whole(_, true) => f64::from(whole as i32),
                Kind::Whole(_, false) => f64::from(whole),
            });
        }
        Ok(())
    }

    fn text(&mut self) -> Result<(), FormatError> {
        let Row { values, bytes } = &mut self.row;
        let done = self.element.count - self.left;
        let bad = |what: &str| FormatError::invalid(self.path, format!("{} {done}: {what}", self.element.name));
        // Empty lines are none.
        loop {
            bytes.clear();
            let mut byte = [0];
            while self.input.read(&mut byte).map_err(|e| FormatError::io(self.path, "reading", e))? == 1 {
                if byte[0] == b'\n' {
                    break;
                }
                if bytes.len() as u64 == MAX_LINE {
                    return Err(bad("its line is longer than its numbers can be"));
                }
                bytes.push(byte[0]);
            }
            if bytes.is_empty() && byte[0] != b'\n' {
                return Err(bad("the file ends before it"));
            }
            if !bytes.trim_ascii().is_empty() {
                break;
            }
        }
        let text = std::str::from_utf8(bytes).map_err(|_| bad("is no text"))?;
        values.clear();
        for word in text.split_ascii_whitespace() {
            values.push(word.parse().map_err(|_| bad(&format!("{word:?} is no number")))?);
        }
        match values.len() == self.element.properties.len() {
            true => Ok(()),
            false => Err(bad(&format!("has {} numbers of {}", values.len(), self.element.properties.len()))),
        }
    }
}
