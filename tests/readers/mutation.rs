//! Structure-aware mutation on stable Rust: from whole files to broken ones that keep enough of their structure to get past
//! the first check. The same seed gives the same inputs on every machine.

/// SplitMix64 (Steele, Lea and Flood 2014).
pub struct Random(u64);

impl Random {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// 0 to `n` − 1; 0 of nothing.
    pub fn below(&mut self, n: usize) -> usize {
        if n == 0 { 0 } else { (self.next() % n as u64) as usize }
    }

    fn pick<'a, T: ?Sized>(&mut self, of: &[&'a T]) -> &'a T {
        of[self.below(of.len())]
    }
}

/// Numbers at which readers go wrong: bounds, signs, sizes whose product overflows, floats that are no numbers.
const WORDS: [u64; 18] = [
    0,
    1,
    2,
    0x7F,
    0xFF,
    0xFFFF,
    0x7FFF_FFFF,
    0x8000_0000,
    0xFFFF_FFFF,
    1 << 32,
    1 << 40,
    i64::MAX as u64,
    u64::MAX,
    0x7FC0_0000,           // NaN
    0x7F80_0000,           // infinity
    0x7F7F_FFFF,           // f32::MAX
    0x7FF8_0000_0000_0000, // NaN
    0x7FF0_0000_0000_0000, // infinity
];

/// Numbers worth trying in text.
const NUMBERS: [&str; 16] = [
    "0",
    "-1",
    "1",
    "0.0",
    "1e-320",
    "1e308",
    "1e999",
    "-1e999",
    "NaN",
    "2147483648",
    "4294967296",
    "9223372036854775808",
    "18446744073709551616",
    "\"x\"",
    "null",
    "[]",
];

/// One to four changes to `input`; `other` is another whole file of the format, to take parts of.
pub fn mutate(input: &[u8], other: &[u8], text: bool, random: &mut Random) -> Vec<u8> {
    let mut bytes = input.to_vec();
    for _ in 0..1 + random.below(4) {
        match text && random.below(4) != 0 {
            true => in_text(&mut bytes, other, random),
            false => in_bytes(&mut bytes, other, random),
        }
    }
    bytes
}

fn in_bytes(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let at = random.below(bytes.len());
    let length = 1 + random.below(bytes.len().min(64));
    let end = (at + length).min(bytes.len());
    match random.below(10) {
        0 if !bytes.is_empty() => bytes[at] ^= 1 << random.below(8),
        1 if !bytes.is_empty() => bytes[at] = random.next() as u8,
        // A whole word, on its own boundary more often than not: counts and floats lie there.
        2..=4 if !bytes.is_empty() => {
            let width = [2, 4, 8][random.below(3)];
            let at = if random.below(3) == 0 { at } else { at / width * width };
            let value = match random.below(4) {
                0 => (bytes.len() as u64).wrapping_add(random.next() % 5).wrapping_sub(2),
                _ => WORDS[random.below(WORDS.len())],
            };
            for (byte, new) in bytes[at..].iter_mut().zip(&value.to_le_bytes()[..width]) {
                *byte = *new;
            }
        }
        5 => bytes.truncate(at),
        6 => drop(bytes.drain(at..end)),
        7 => {
            let part = bytes[at..end].to_vec();
            let to = random.below(bytes.len());
            bytes.splice(to..to, part);
        }
        8 => {
            let from = random.below(other.len());
            let part = other[from..(from + length).min(other.len())].to_vec();
            bytes.splice(at..end, part);
        }
        _ => {
            let part: Vec<u8> = (0..length).map(|_| random.next() as u8).collect();
            bytes.splice(at..at, part);
        }
    }
}

fn in_text(bytes: &mut Vec<u8>, other: &[u8], random: &mut Random) {
    let is_number = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
    match random.below(8) {
        0..=2 => {
            // One of the numbers, whole, becomes another.
            let start = random.below(bytes.len());
            let Some(from) = bytes[start..].iter().position(is_number).map(|i| start + i) else { return };
            let to = bytes[from..].iter().position(|b| !is_number(b)).map_or(bytes.len(), |i| from + i);
            bytes.splice(from..to, random.pick(&NUMBERS).bytes());
        }
        3..=5 => {
            let mut lines: Vec<&[u8]> = bytes.split_inclusive(|b| *b == b'\n').collect();
            let theirs: Vec<&[u8]> = other.split_inclusive(|b| *b == b'\n').collect();
            if lines.is_empty() || theirs.is_empty() {
                return;
            }
            let at = random.below(lines.len());
            match random.below(4) {
                0 => drop(lines.remove(at)),
                1 => lines.insert(at, lines[random.below(lines.len())]),
                2 => lines.swap(at, random.below(bytes.iter().filter(|b| **b == b'\n').count().max(1))),
                _ => lines[at] = theirs[random.below(theirs.len())],
            }
            *bytes = lines.concat();
        }
        6 => {
            let at = random.below(bytes.len());
            // Rarely deeper than any stack that is used for each of them.
            let many = if random.below(64) == 0 { 16_000 } else { 1 + random.below(300) };
            let nested = random.pick(&["[", "{\"a\":", "(", "\"", "\\", "-", "a.", "<a>", "<a b='c'>"]);
            bytes.splice(at..at, nested.repeat(many).into_bytes());
        }
        _ => {
            let at = random.below(bytes.len());
            bytes.splice(at..at, [0xFF, 0xC0, 0x00][..1 + random.below(3)].iter().copied());
        }
    }
}
