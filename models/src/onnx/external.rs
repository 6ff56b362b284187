//! Weights that an ONNX file keeps in other files. The hash in the manifest does not cover those, and the runtime looks for them
//! where the program was started: such a network is refused.
//!
//! Protocol Buffers' wire format, with the field numbers of `onnx.proto3` (ONNX IR version 10).

/// Messages within messages that are followed: Protocol Buffers' own limit, with which the runtime refuses what is deeper.
const DEPTH: u32 = 100;

/// A kind of message that tensors can be in.
#[derive(Clone, Copy)]
enum Kind {
    Model,
    Graph,
    Function,
    Node,
    Attribute,
    Tensor,
    SparseTensor,
    /// A key and its value.
    Entry,
}

impl Kind {
    /// What kind a field's content is; `None`: it has no tensors in it.
    fn within(self, field: u64) -> Option<Self> {
        match (self, field) {
            (Self::Model, 7) => Some(Self::Graph),
            (Self::Model, 25) => Some(Self::Function),
            (Self::Graph, 1) | (Self::Function, 7) => Some(Self::Node),
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) | (Self::SparseTensor, 1 | 2) => Some(Self::Tensor),
            (Self::Graph, 15) | (Self::Attribute, 22 | 23) => Some(Self::SparseTensor),
            (Self::Node, 5) | (Self::Function, 11) => Some(Self::Attribute),
            (Self::Attribute, 6 | 11) => Some(Self::Graph),
            (Self::Tensor, 13) => Some(Self::Entry),
            _ => None,
        }
    }
}

/// The name of a file that the network keeps a tensor in; empty where it gives none. `None`: all are in it, as far as its bytes can
/// be understood.
pub(super) fn file_of(network: &[u8]) -> Option<String> {
    search(network, Kind::Model, DEPTH)
}

fn search(mut message: &[u8], kind: Kind, depth: u32) -> Option<String> {
    let mut is_elsewhere = false;
    let mut location = None;
    while let Some((field, content)) = next_field(&mut message) {
        match (kind, field, content) {
            // data_location = EXTERNAL
            (Kind::Tensor, 14, Content::Number(1)) => is_elsewhere = true,
            (Kind::Tensor, 13, Content::Bytes(entry)) => {
                is_elsewhere = true;
                location = location.or_else(|| value_of(entry, b"location"));
            }
            (_, _, Content::Bytes(bytes)) if depth > 0 => {
                if let Some(kind) = kind.within(field)
                    && let Some(file) = search(bytes, kind, depth - 1)
                {
                    return Some(file);
                }
            }
            _ => {}
        }
    }
    is_elsewhere.then(|| location.unwrap_or_default())
}

/// The value of an entry with this key.
fn value_of(mut entry: &[u8], key: &[u8]) -> Option<String> {
    let (mut is_it, mut value) = (false, None);
    while let Some((field, content)) = next_field(&mut entry) {
        match (field, content) {
            (1, Content::Bytes(bytes)) => is_it = bytes == key,
            (2, Content::Bytes(bytes)) => value = Some(String::from_utf8_lossy(bytes).into_owned()),
            _ => {}
        }
    }
    value.filter(|_| is_it)
}

enum Content<'a> {
    Number(u64),
    Bytes(&'a [u8]),
}

/// Takes a field off; `None` at the end, or at what is no field.
fn next_field<'a>(message: &mut &'a [u8]) -> Option<(u64, Content<'a>)> {
    let tag = number(message)?;
    let content = match tag & 7 {
        0 => Content::Number(number(message)?),
        1 => Content::Bytes(take(message, 8)?),
        2 => {
            let length = usize::try_from(number(message)?).ok()?;
            Content::Bytes(take(message, length)?)
        }
        // The bounds of a group, which ONNX has none of: what is in it is read as if it stood here.
        3 | 4 => Content::Bytes(&[]),
        5 => Content::Bytes(take(message, 4)?),
        _ => return None,
    };
    Some((tag >> 3, content))
}

fn take<'a>(message: &mut &'a [u8], length: usize) -> Option<&'a [u8]> {
    let (taken, rest) = message.split_at_checked(length)?;
    *message = rest;
    Some(taken)
}

fn number(message: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let (&byte, rest) = message.split_first()?;
        *message = rest;
        value |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

/// Writes networks as bytes, for tests.
#[cfg(test)]
pub(super) mod writing {
    fn number(mut value: u64) -> Vec<u8> {
        let mut bytes = Vec::new();
        while value >= 0x80 {
            bytes.push(value as u8 | 0x80);
            value >>= 7;
        }
        bytes.push(value as u8);
        bytes
    }

    pub(crate) fn bytes(field: u64, content: &[u8]) -> Vec<u8> {
        [number(field << 3 | 2), number(content.len() as u64), content.to_vec()].concat()
    }

    pub(crate) fn int(field: u64, value: u64) -> Vec<u8> {
        [number(field << 3), number(value)].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::writing::{bytes, int};
    use super::*;

    /// A tensor called `w` in the file `location`.
    fn tensor(location: &str) -> Vec<u8> {
        let entry = [bytes(1, b"location"), bytes(2, location.as_bytes())].concat();
        [bytes(8, b"w"), bytes(13, &entry), int(14, 1)].concat()
    }

    /// It as an initializer of a graph within `depth` graphs of loops.
    fn nested(depth: usize) -> Vec<u8> {
        let innermost = bytes(5, &tensor("weights.bin"));
        let graph = (0..depth).fold(innermost, |graph, _| bytes(1, &bytes(5, &bytes(6, &graph))));
        bytes(7, &graph)
    }

    #[test]
    fn a_tensor_in_another_file_is_found_wherever_in_the_network_it_stands() {
        let tensor = tensor("weights.bin");
        let constant = bytes(7, &bytes(1, &bytes(5, &bytes(5, &tensor))));
        let in_a_function = bytes(25, &bytes(7, &bytes(5, &bytes(5, &tensor))));
        let sparse = bytes(7, &bytes(15, &bytes(1, &tensor)));
        let after_a_group = [vec![99 << 3 & 0x7f | 3 | 0x80, 6, 99 << 3 & 0x7f | 4 | 0x80, 6], nested(0)].concat();
        for network in [nested(0), constant, nested(1), nested(20), in_a_function, sparse, after_a_group] {
            assert_eq!(file_of(&network).as_deref(), Some("weights.bin"));
            // Cut anywhere it ends.
            (0..network.len()).for_each(|n| drop(file_of(&network[..n])));
        }
        assert_eq!(file_of(&bytes(7, &bytes(5, &int(14, 1)))), Some(String::new()));
    }

    #[test]
    fn bytes_of_weights_and_names_are_not_taken_for_what_they_are_not() {
        // raw_data that looks like a reference.
        assert_eq!(file_of(&bytes(7, &bytes(5, &bytes(9, &tensor("x"))))), None);
        assert_eq!(file_of(include_bytes!("../../networks/xfeat.onnx")), None);
        assert_eq!(file_of(&[0xff; 64]), None);
        assert_eq!(file_of(&nested(10_000)), None, "deeper than the runtime reads, and it ends");
    }
}
