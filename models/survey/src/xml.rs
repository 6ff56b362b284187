//! XML of other people's files, parsed without following elements nested by the thousand: the parser calls itself for each.

use roxmltree::Document;

/// Elements within elements that are followed; the XMP of cameras has five.
const MOST_NESTED: usize = 64;

/// Parses a document. Entities are not expanded beyond XML's own.
///
/// # Errors
/// Why it is no XML, or that its elements are nested too deeply.
pub fn parse(text: &str) -> Result<Document<'_>, String> {
    if !is_shallow(text) {
        return Err(format!("its elements are nested more than {MOST_NESTED} deep, or one does not end"));
    }
    Document::parse(text).map_err(|e| disk::escaped(&e.to_string()))
}

/// Whether no element of `xml` lies deeper than the parser may follow; false for markup that does not end.
fn is_shallow(xml: &str) -> bool {
    let (mut rest, mut depth) = (xml, 0usize);
    while let Some(start) = rest.find('<') {
        rest = &rest[start..];
        let passed =
            [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")].into_iter().find(|(open, _)| rest.starts_with(open));
        let end = match passed {
            Some((open, close)) => rest[open.len()..].find(close).map(|n| open.len() + n + close.len()),
            None => tag_end(rest),
        };
        let Some(end) = end else { return false };
        if passed.is_none() {
            match &rest[..end] {
                tag if tag.starts_with("</") => depth = depth.saturating_sub(1),
                tag if tag.ends_with("/>") => {}
                _ => depth += 1,
            }
        }
        if depth > MOST_NESTED {
            return false;
        }
        rest = &rest[end..];
    }
    true
}

/// Bytes up to and with the `>` that ends the tag at the start of `xml`; one within quotes does not.
fn tag_end(xml: &str) -> Option<usize> {
    let mut quote = None;
    for (at, c) in xml.bytes().enumerate() {
        match (quote, c) {
            (None, b'>') => return Some(at + 1),
            (None, b'"' | b'\'') => quote = Some(c),
            (Some(q), c) if q == c => quote = None,
            _ => {}
        }
    }
    None
}
