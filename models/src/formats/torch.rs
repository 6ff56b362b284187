//! What PyTorch's `torch.save` writes for a dictionary of numbers and small tensors: a zip with a pickle of protocol 2 and one entry
//! of raw numbers per tensor (`torch/serialization.py`). Of the pickle's machine there is here what such files use; what it would
//! call is not called.

use std::collections::HashMap;
use std::io::{Cursor, Read};
use std::path::Path;
use std::rc::Rc;

use zip::ZipArchive;

use super::{FormatError, read_bounded};

/// Such a file has 2 KiB.
const LIMIT: u64 = 64 << 10;
/// Numbers of a tensor at most: a pose has 12.
const MOST_NUMBERS: usize = 64;
/// Entries of a dictionary at most: a picture's has five.
const MOST_ENTRIES: usize = 64;
/// Tuples within tuples: a tensor has three of them.
const DEEPEST: u8 = 8;

/// The numbers of every entry, row by row for a tensor.
pub type Numbers = HashMap<String, Vec<f64>>;

/// Reads the dictionary; entries that are no numbers are left out.
///
/// # Errors
/// The file cannot be read, or is no such file.
pub fn read(path: &Path) -> Result<Numbers, FormatError> {
    let bytes = read_bounded(path, LIMIT)?;
    numbers(&bytes).map_err(|what| FormatError::invalid(path, format!("not a dictionary of torch.save: {what}")))
}

fn numbers(bytes: &[u8]) -> Result<Numbers, String> {
    let mut zip = ZipArchive::new(Cursor::new(bytes)).map_err(super::one_line)?;
    let pickle = zip.file_names().find(|n| n.ends_with("data.pkl")).ok_or("it has no data.pkl")?.to_owned();
    let folder = pickle.trim_end_matches("data.pkl").to_owned();
    let mut entry = |name: &str, what: &str| {
        let mut bytes = Vec::new();
        let entry = zip.by_name(name).map_err(|e| format!("its {what}: {}", super::one_line(e)))?;
        entry.take(LIMIT).read_to_end(&mut bytes).map_err(|e| format!("its {what}: {e}"))?;
        Ok::<_, String>(bytes)
    };
    let program = entry(&pickle, "pickle")?;
    let Value::Dictionary(entries) = Machine::run(&program)? else {
        return Err("it holds something else".to_owned());
    };
    let mut numbers = Numbers::new();
    for (name, value) in entries {
        let values = match value {
            Value::Number(v) => vec![v],
            Value::Tensor(tensor) => {
                tensor.gather(&entry(&format!("{folder}data/{}", tensor.storage.key), "numbers of a tensor")?)?
            }
            _ => continue,
        };
        numbers.insert(name.to_string(), values);
    }
    Ok(numbers)
}

/// Where the numbers of a tensor lie, and as what.
#[derive(Clone, Debug)]
struct Storage {
    key: Rc<str>,
    /// Name of its class: `FloatStorage`, …
    class: Rc<str>,
}

#[derive(Clone, Debug)]
struct Tensor {
    storage: Storage,
    offset: usize,
    size: Vec<usize>,
    stride: Vec<usize>,
}

impl Tensor {
    /// Of what a tensor is rebuilt from: storage, offset, sizes and strides.
    fn of(arguments: &[Value]) -> Option<Self> {
        let [Value::Storage(storage), offset, Value::Tuple(size, _), Value::Tuple(stride, _), ..] = arguments else {
            return None;
        };
        let all = |values: &[Value]| values.iter().map(Value::index).collect::<Option<Vec<usize>>>();
        let (size, stride) = (all(size)?, all(stride)?);
        let numbers = size.iter().try_fold(1usize, |n, side| n.checked_mul(*side))?;
        (size.len() == stride.len() && numbers <= MOST_NUMBERS).then_some(())?;
        Some(Self { storage: storage.clone(), offset: offset.index()?, size, stride })
    }

    fn gather(&self, raw: &[u8]) -> Result<Vec<f64>, String> {
        let bytes = match &*self.storage.class {
            "FloatStorage" | "IntStorage" => 4,
            "DoubleStorage" | "LongStorage" => 8,
            _ => {
                return Err(
                    "a tensor of it is neither of floats nor of integers; save it as float or double".to_owned()
                );
            }
        };
        let number = |at: usize| -> Option<f64> {
            let word = raw.get(at.checked_mul(bytes)?..)?.get(..bytes)?;
            Some(match &*self.storage.class {
                "FloatStorage" => f32::from_le_bytes(word.try_into().ok()?).into(),
                "IntStorage" => i32::from_le_bytes(word.try_into().ok()?).into(),
                "DoubleStorage" => f64::from_le_bytes(word.try_into().ok()?),
                _ => i64::from_le_bytes(word.try_into().ok()?) as f64,
            })
        };
        let count: usize = self.size.iter().product();
        let place = |mut i: usize| {
            let mut at = self.offset;
            for (side, stride) in self.size.iter().zip(&self.stride).rev() {
                at = at.checked_add((i % side).checked_mul(*stride)?)?;
                i /= side;
            }
            Some(at)
        };
        let values = (0..count).map(|i| place(i).and_then(number)).collect::<Option<Vec<f64>>>();
        values.ok_or_else(|| "a tensor reaches beyond its storage".to_owned())
    }
}

#[derive(Clone, Debug)]
enum Value {
    Number(f64),
    Text(Rc<str>),
    /// With how deep it is.
    Tuple(Rc<[Value]>, u8),
    Dictionary(Vec<(Rc<str>, Value)>),
    /// Name of a class or function.
    Name(Rc<str>),
    Storage(Storage),
    Tensor(Rc<Tensor>),
    /// Nothing, or what no number comes of.
    Other,
}

impl Value {
    fn index(&self) -> Option<usize> {
        match self {
            Self::Number(v) if *v >= 0.0 && *v <= LIMIT as f64 && v.fract() == 0.0 => Some(*v as usize),
            _ => None,
        }
    }

    fn tuple(values: Vec<Value>) -> Result<Self, String> {
        let depth = |v: &Value| if let Self::Tuple(_, depth) = v { *depth } else { 0 };
        let depth = 1 + values.iter().map(depth).max().unwrap_or(0);
        match depth <= DEEPEST {
            true => Ok(Self::Tuple(values.into(), depth)),
            false => Err("its tuples are nested too deeply".to_owned()),
        }
    }
}

/// The pickle's machine: a stack, marks on it, and what was put aside.
struct Machine<'a> {
    program: &'a [u8],
    at: usize,
    stack: Vec<Value>,
    marks: Vec<usize>,
    memo: HashMap<u32, Value>,
}

impl<'a> Machine<'a> {
    /// What is left when the program stops. Operations as in CPython's `Lib/pickletools.py`.
    fn run(program: &'a [u8]) -> Result<Value, String> {
        let mut this = Self { program, at: 0, stack: Vec::new(), marks: Vec::new(), memo: HashMap::new() };
        loop {
            let operation = this.take(1)?[0];
            match operation {
                b'.' => return this.pop(),
                0x80 => drop(this.take(1)?),
                b'(' => this.marks.push(this.stack.len()),
                b'N' | b']' | 0x89 => {
                    this.stack.push(if operation == 0x89 { Value::Number(0.0) } else { Value::Other })
                }
                0x88 => this.stack.push(Value::Number(1.0)),
                b'}' => this.stack.push(Value::Dictionary(Vec::new())),
                b')' => this.stack.push(Value::tuple(Vec::new())?),
                b'K' => this.number(1)?,
                b'M' => this.number(2)?,
                b'J' => {
                    let v = i32::from_le_bytes(this.array()?);
                    this.stack.push(Value::Number(v.into()));
                }
                b'G' => {
                    let v = f64::from_be_bytes(this.array()?);
                    this.stack.push(Value::Number(v));
                }
                0x8a => {
                    let bytes = usize::from(this.take(1)?[0]);
                    this.long(bytes)?;
                }
                b'X' => {
                    let bytes = u32::from_le_bytes(this.array()?) as usize;
                    let text = std::str::from_utf8(this.take(bytes)?).map_err(|_| "a text is not UTF-8")?;
                    this.stack.push(Value::Text(text.into()));
                }
                b'c' => {
                    let (_, name) = (this.line()?, this.line()?);
                    this.stack.push(Value::Name(name.into()));
                }
                b'q' => {
                    let to = this.take(1)?[0];
                    this.keep(to.into())?;
                }
                b'r' => {
                    let to = u32::from_le_bytes(this.array()?);
                    this.keep(to)?;
                }
                b'h' => {
                    let from = this.take(1)?[0];
                    this.fetch(from.into())?;
                }
                b'j' => {
                    let from = u32::from_le_bytes(this.array()?);
                    this.fetch(from)?;
                }
                b't' => {
                    let values = this.since_mark()?;
                    this.stack.push(Value::tuple(values)?);
                }
                0x85..=0x87 => {
                    let from = this.stack.len().checked_sub(usize::from(operation - 0x84)).ok_or(SHORT)?;
                    let values = this.stack.split_off(from);
                    this.stack.push(Value::tuple(values)?);
                }
                b'Q' => {
                    let id = this.pop()?;
                    this.stack.push(storage(&id).ok_or("it refers to something that is no storage")?);
                }
                b'R' => {
                    let (arguments, callee) = (this.pop()?, this.pop()?);
                    this.stack.push(rebuilt(&callee, &arguments));
                }
                b's' => {
                    let (value, key) = (this.pop()?, this.pop()?);
                    this.enter(vec![key, value])?;
                }
                b'u' => {
                    let values = this.since_mark()?;
                    this.enter(values)?;
                }
                // What is appended to a list, or set of an object, no number comes of.
                b'e' => drop(this.since_mark()?),
                b'a' | b'b' => drop(this.pop()?),
                other => return Err(format!("its pickle does {other:#04x}, which no dictionary of numbers needs")),
            }
        }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let taken =
            self.program.get(self.at..).and_then(|rest| rest.get(..count)).ok_or("its pickle ends too early")?;
        self.at += count;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        self.take(N)?.try_into().map_err(|_| SHORT.to_owned())
    }

    fn line(&mut self) -> Result<&'a str, String> {
        let rest = self.program.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|b| *b == b'\n').ok_or("a name does not end")?;
        let line = self.take(length + 1)?;
        std::str::from_utf8(&line[..length]).map_err(|_| "a name is not UTF-8".to_owned())
    }

    fn number(&mut self, bytes: usize) -> Result<(), String> {
        let v = self.take(bytes)?.iter().rev().fold(0u32, |v, b| v << 8 | u32::from(*b));
        self.stack.push(Value::Number(v.into()));
        Ok(())
    }

    /// A number of so many bytes, in two's complement.
    fn long(&mut self, bytes: usize) -> Result<(), String> {
        let word = self.take(bytes)?;
        if bytes > 8 {
            return Err("a number of it is too long".to_owned());
        }
        let negative = word.last().is_some_and(|b| b & 0x80 != 0);
        let v = word.iter().rev().fold(if negative { -1i64 } else { 0 }, |v, b| v << 8 | i64::from(*b));
        self.stack.push(Value::Number(v as f64));
        Ok(())
    }

    fn pop(&mut self) -> Result<Value, String> {
        let bottom = self.marks.last().copied().unwrap_or(0);
        match self.stack.len() > bottom {
            true => self.stack.pop().ok_or_else(|| SHORT.to_owned()),
            false => Err(SHORT.to_owned()),
        }
    }

    fn since_mark(&mut self) -> Result<Vec<Value>, String> {
        let mark = self.marks.pop().filter(|m| *m <= self.stack.len()).ok_or(SHORT)?;
        Ok(self.stack.split_off(mark))
    }

    fn keep(&mut self, to: u32) -> Result<(), String> {
        let value = self.stack.last().ok_or(SHORT)?;
        // Dictionaries fill later, and none of ours is used twice.
        let value = if matches!(value, Value::Dictionary(_)) { Value::Other } else { value.clone() };
        self.memo.insert(to, value);
        Ok(())
    }

    fn fetch(&mut self, from: u32) -> Result<(), String> {
        let value = self.memo.get(&from).ok_or("it uses what it never put aside")?.clone();
        self.stack.push(value);
        Ok(())
    }

    /// Enters keys and values in turn into the dictionary on top; into anything else (ordered dictionaries of hooks) nothing.
    fn enter(&mut self, values: Vec<Value>) -> Result<(), String> {
        let into = self.stack.last_mut().ok_or(SHORT)?;
        let Value::Dictionary(entries) = into else { return Ok(()) };
        let mut values = values.into_iter();
        while let (Some(key), Some(value)) = (values.next(), values.next()) {
            if let Value::Text(key) = key {
                entries.push((key, value));
            }
            if entries.len() > MOST_ENTRIES {
                return Err("its dictionary has too many entries".to_owned());
            }
        }
        Ok(())
    }
}

const SHORT: &str = "its pickle takes more from its stack than is there";

/// ("storage", class, key, device, numbers).
fn storage(id: &Value) -> Option<Value> {
    let Value::Tuple(parts, _) = id else { return None };
    let [Value::Text(kind), Value::Name(class), Value::Text(key), ..] = &parts[..] else { return None };
    (&**kind == "storage").then(|| Value::Storage(Storage { key: key.clone(), class: class.clone() }))
}

/// What a call would return, where it is a tensor.
fn rebuilt(callee: &Value, arguments: &Value) -> Value {
    match (callee, arguments) {
        (Value::Name(name), Value::Tuple(arguments, _)) if &**name == "_rebuild_tensor_v2" => {
            Tensor::of(arguments).map_or(Value::Other, |t| Value::Tensor(Rc::new(t)))
        }
        _ => Value::Other,
    }
}
