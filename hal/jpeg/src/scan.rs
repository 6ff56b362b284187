//! The scans of a sequential picture: whether all of its blocks are there. Blocks are passed over, none is computed.

use crate::table::Table;
use crate::{CUT, DAMAGED};

/// Bits that an encoder may have left out at the end, where they are zeros.
const LEFT_OUT: u32 = 32;
/// A scan that goes on for longer than this behind the picture, and for more than this share of it, was not read as it was written.
const SURPLUS: usize = 1024;
const SURPLUS_SHARE: usize = 20;

/// One component: its name, and blocks across and down in a unit of a scan of all.
#[derive(Clone, Copy)]
struct Component {
    id: u8,
    across: usize,
    down: usize,
    is_seen: bool,
}

/// The picture.
pub(crate) struct Frame {
    width: usize,
    height: usize,
    components: Vec<Component>,
}

/// A component in a scan.
struct Part<'a> {
    blocks: usize,
    dc: &'a Table,
    ac: &'a Table,
}

impl Frame {
    /// `None` for one whose scans say what its size is, and for what is no header.
    pub fn read(content: &[u8]) -> Option<Self> {
        let (&[_, h1, h2, w1, w2, count], rest) = content.split_first_chunk::<6>()?;
        let [height, width] = [[h1, h2], [w1, w2]].map(|n| usize::from(u16::from_be_bytes(n)));
        let components: Vec<_> = rest
            .chunks_exact(3)
            .take(count.into())
            .map(|c| Component { id: c[0], across: (c[1] >> 4).into(), down: (c[1] & 15).into(), is_seen: false })
            .collect();
        let is_sound = components.iter().all(|c| (1..=4).contains(&c.across) && (1..=4).contains(&c.down));
        let is_there = width > 0 && height > 0 && !components.is_empty() && components.len() == count.into();
        (is_sound && is_there).then_some(Self { width, height, components })
    }

    /// Each component was in a scan.
    pub fn is_seen(&self) -> bool {
        self.components.iter().all(|c| c.is_seen)
    }

    /// Passes over the blocks of a scan that begins at `data`; how many bytes they take, 0 where its tables are not known.
    pub fn walk(
        &mut self,
        header: &[u8],
        dc: &[Option<Table>],
        ac: &[Option<Table>],
        restart: usize,
        data: &[u8],
    ) -> Result<usize, &'static str> {
        let most = |of: fn(&Component) -> usize| self.components.iter().map(of).max().unwrap_or(1);
        let (across, down) = (most(|c| c.across), most(|c| c.down));
        let Some((count, named)) = header.split_first() else { return Ok(0) };
        let (mut parts, mut units) = (Vec::new(), 0);
        for named in named.chunks_exact(2).take((*count).into()) {
            let Some(component) = self.components.iter_mut().find(|c| c.id == named[0]) else { return Ok(0) };
            component.is_seen = true;
            let table = |of: &'_ [Option<Table>], n: u8| of.get(usize::from(n)).is_some_and(Option::is_some);
            if !table(dc, named[1] >> 4) || !table(ac, named[1] & 15) {
                return Ok(0);
            }
            let (Some(dc), Some(ac)) = (&dc[usize::from(named[1] >> 4)], &ac[usize::from(named[1] & 15)]) else {
                return Ok(0);
            };
            if *count == 1 {
                // Alone, a component has no more blocks than it needs.
                let side = |length: usize, own: usize, most: usize| (length * own).div_ceil(most).div_ceil(8);
                units = side(self.width, component.across, across) * side(self.height, component.down, down);
                parts.push(Part { blocks: 1, dc, ac });
            } else {
                units = self.width.div_ceil(8 * across) * self.height.div_ceil(8 * down);
                parts.push(Part { blocks: component.across * component.down, dc, ac });
            }
        }
        let mut bits = Bits { data, at: 0, buffer: 0, count: 0, zeros: 0 };
        for unit in 0..units {
            if restart > 0 && unit > 0 && unit % restart == 0 {
                bits.restart()?;
            }
            for part in &parts {
                for _ in 0..part.blocks {
                    bits.pass_over_block(part)?;
                }
            }
            if bits.overread() > LEFT_OUT {
                return Err(CUT);
            }
        }
        Ok(bits.passed())
    }
}

/// Where the marker is that ends a scan.
pub(crate) fn end(data: &[u8]) -> Option<usize> {
    let mut at = 0;
    loop {
        at += data.get(at..)?.iter().position(|b| *b == 0xFF)?;
        let fill = data[at..].iter().position(|b| *b != 0xFF)?;
        match data[at + fill] {
            0 | 0xD0..=0xD7 => at += fill + 1,
            _ => return Some(at),
        }
    }
}

/// Whether what remains of a scan of which so many bytes were read is more than what encoders leave there.
pub(crate) fn is_damaged(rest: &[u8], read: usize) -> bool {
    let said = rest.iter().filter(|b| **b != 0xFF).count();
    said > SURPLUS && said * SURPLUS_SHARE > read
}

/// The bits of a scan, and zeros behind them.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    buffer: u64,
    count: u32,
    /// How many of those in the buffer are none of the scan's.
    zeros: u32,
}

impl Bits<'_> {
    fn fill(&mut self) {
        while self.count <= 48 {
            let byte = match self.data.get(self.at..) {
                Some([0xFF, 0, ..]) => {
                    self.at += 2;
                    0xFF
                }
                Some([byte, ..]) if *byte != 0xFF => {
                    self.at += 1;
                    *byte
                }
                // A marker, or the end of the file.
                _ => {
                    self.zeros += 8;
                    0
                }
            };
            self.buffer = self.buffer << 8 | u64::from(byte);
            self.count += 8;
        }
    }

    fn code(&mut self, table: &Table) -> Result<u8, &'static str> {
        // A code and its value's own bits.
        if self.count < 32 {
            self.fill();
        }
        let next = (self.buffer >> (self.count - 16)) as u16;
        match table.look_up(next) {
            Some((length, value)) => {
                self.count -= length;
                Ok(value)
            }
            None => Err(if self.overread() > 0 || self.zeros > 0 { CUT } else { DAMAGED }),
        }
    }

    /// A value's own bits: at most 16, which [`Bits::code`] left.
    fn pass_over(&mut self, bits: u8) {
        self.count -= u32::from(bits & 15);
    }

    fn pass_over_block(&mut self, part: &Part<'_>) -> Result<(), &'static str> {
        let bits = self.code(part.dc)?;
        self.pass_over(bits);
        let mut k = 1;
        while k < 64 {
            let value = self.code(part.ac)?;
            match (value >> 4, value & 15) {
                (15, 0) => k += 16,
                (_, 0) => break,
                (run, bits) => {
                    k += u32::from(run) + 1;
                    self.pass_over(bits);
                }
            }
        }
        // Some encoders end a block by a run that leads beyond it.
        if k <= 64 + 15 { Ok(()) } else { Err(DAMAGED) }
    }

    /// Bits read of those that are none of the scan's.
    fn overread(&self) -> u32 {
        self.zeros.saturating_sub(self.count)
    }

    /// Bytes up to the next whole one that was not read.
    fn passed(&self) -> usize {
        let unread = self.count.saturating_sub(self.zeros) / 8;
        self.at.saturating_sub(unread as usize)
    }

    fn restart(&mut self) -> Result<(), &'static str> {
        if self.overread() > LEFT_OUT {
            return Err(CUT);
        }
        loop {
            // Up to the marker.
            let rest = self.data.get(self.at..).unwrap_or_default();
            self.at += rest.iter().position(|b| *b == 0xFF).ok_or(CUT)?;
            let fill = self.data[self.at..].iter().position(|b| *b != 0xFF).ok_or(CUT)?;
            let marker = self.data[self.at + fill];
            self.at += fill;
            match marker {
                0 => self.at += 1,
                0xD0..=0xD7 => break,
                // What ends the scan is its end's business.
                _ => return Err(CUT),
            }
        }
        self.at += 1;
        (self.buffer, self.count, self.zeros) = (0, 0, 0);
        Ok(())
    }
}
