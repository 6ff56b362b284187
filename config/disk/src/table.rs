//! Names in tables that spreadsheets open.

use std::borrow::Cow;

/// A name as one field of one line (RFC 4180). A line end in it would begin a line of its own, and a spreadsheet computes
/// what begins with one of `=+-@`: such names get a quotation mark before them.
pub fn field(name: &str) -> Cow<'_, str> {
    let formula = name.starts_with(['=', '+', '-', '@']);
    if !formula && !name.contains(|c: char| c.is_control() || matches!(c, ',' | '"')) {
        return Cow::Borrowed(name);
    }
    let printable = name.replace(|c: char| c.is_control(), "_").replace('"', "\"\"");
    Cow::Owned(format!("\"{}{printable}\"", if formula { "'" } else { "" }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_one_field_of_one_line_and_no_formula() {
        assert_eq!(field("DJI_0001.JPG"), "DJI_0001.JPG");
        assert_eq!(field("a,b\n0,1\u{85}.jpg"), "\"a,b_0,1_.jpg\"");
        assert_eq!(field("a\"b.jpg"), "\"a\"\"b.jpg\"");
        assert_eq!(field("=HYPERLINK(1).jpg"), "\"'=HYPERLINK(1).jpg\"");
    }
}
