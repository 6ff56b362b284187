//! Huffman codes (T.81, annexes C and F).

/// Codes of up to so many bits are looked up at once.
const FAST: u32 = 9;

/// The code of one table.
pub(crate) struct Table {
    /// By the next [`FAST`] bits: length of the code and value; length 0 where the code is longer.
    fast: [(u8, u8); 1 << FAST],
    /// By length: the first code behind the last one, and what leads from a code to its value.
    ends: [u32; 17],
    shifts: [i32; 17],
    values: Vec<u8>,
}

impl Table {
    /// The first table of a segment, its kind and number, and the rest.
    pub fn read(content: &[u8]) -> Option<(Self, u8, &[u8])> {
        let (kind, rest) = content.split_first()?;
        let (counts, rest) = rest.split_first_chunk::<16>()?;
        let all = counts.iter().map(|n| usize::from(*n)).sum();
        let (values, rest) = rest.split_at_checked(all)?;
        let mut table = Self { fast: [(0, 0); 1 << FAST], ends: [0; 17], shifts: [0; 17], values: values.to_vec() };
        let (mut code, mut first) = (0u32, 0usize);
        for (length, count) in (1..=16u32).zip(counts) {
            let count = u32::from(*count);
            let at = length as usize;
            table.shifts[at] = first as i32 - code as i32;
            if length <= FAST {
                for (n, value) in (0..count).zip(&values[first..]) {
                    let from = ((code + n) << (FAST - length)) as usize;
                    // Codes that overflow their length are none.
                    let places = table.fast.get_mut(from..from + (1 << (FAST - length)))?;
                    places.fill((length as u8, *value));
                }
            }
            code += count;
            table.ends[at] = code;
            first += count as usize;
            code <<= 1;
        }
        Some((table, *kind, rest))
    }

    /// Length and value of the code with which 16 bits begin.
    pub fn look_up(&self, bits: u16) -> Option<(u32, u8)> {
        let (length, value) = self.fast[usize::from(bits >> (16 - FAST))];
        if length > 0 {
            return Some((length.into(), value));
        }
        (FAST + 1..=16).find_map(|length| {
            let code = u32::from(bits >> (16 - length));
            let at = usize::try_from(code as i32 + self.shifts[length as usize]).ok();
            (code < self.ends[length as usize]).then(|| Some((length, *self.values.get(at?)?))).flatten()
        })
    }
}
