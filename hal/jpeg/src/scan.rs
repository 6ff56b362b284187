//! The scans of a picture: whether all of its blocks are there. Blocks are passed over, none is computed.

use crate::table::Table;
use crate::{CUT, DAMAGED};

/// Bits that an encoder may have left out at the end, where they are zeros.
const LEFT_OUT: u32 = 32;
/// A scan that goes on for longer than this behind the picture, and for more than this share of it, was not read as it was written.
const SURPLUS: usize = 1024;
const SURPLUS_SHARE: usize = 20;
/// Scans of a progressive picture at most; encoders that search for the smallest file write some sixty. Each may take the time of a picture.
const MOST_SCANS: u32 = 200;
/// Pixels a side of the largest progressive picture that is looked into: each of its blocks takes eight bytes.
const LARGEST: usize = 16_384;

/// One component.
struct Component {
    id: u8,
    /// Blocks across and down in a unit of a scan of all.
    across: usize,
    down: usize,
    /// Of each coefficient the lowest bit that was in a scan.
    lowest: [u8; 64],
    /// Of each block the coefficients that are no zeros so far, in a progressive picture.
    sent: Vec<u64>,
}

/// The picture.
pub(crate) struct Frame {
    width: usize,
    height: usize,
    components: Vec<Component>,
    is_progressive: bool,
    scans: u32,
}

/// What a scan holds of each block: everything, or (T.81, annex G) the first bits of coefficients or one more bit of them. Coefficients are
/// the mean, or a band of the others.
#[derive(Clone, Copy)]
enum Pass {
    All,
    Mean,
    MeanBit,
    Band(u32, u32),
    BandBit(u32, u32),
}

/// A component in a scan.
struct Part<'a> {
    component: usize,
    blocks: usize,
    dc: Option<&'a Table>,
    ac: Option<&'a Table>,
}

impl Frame {
    /// `None` for one whose scans say what its size is, and for what is no header.
    pub fn read(content: &[u8], is_progressive: bool) -> Option<Self> {
        let (&[_, h1, h2, w1, w2, count], rest) = content.split_first_chunk::<6>()?;
        let [height, width] = [[h1, h2], [w1, w2]].map(|n| usize::from(u16::from_be_bytes(n)));
        let component = |c: &[u8]| Component {
            id: c[0],
            across: (c[1] >> 4).into(),
            down: (c[1] & 15).into(),
            lowest: [u8::MAX; 64],
            sent: Vec::new(),
        };
        let components: Vec<_> = rest.chunks_exact(3).take(count.into()).map(component).collect();
        let is_sound = components.iter().all(|c| (1..=4).contains(&c.across) && (1..=4).contains(&c.down));
        let is_there = width > 0 && height > 0 && !components.is_empty() && components.len() == count.into();
        let is_small = !is_progressive || width.max(height) <= LARGEST;
        (is_sound && is_there && is_small).then_some(Self { width, height, components, is_progressive, scans: 0 })
    }

    /// All coefficients of each component were in scans, to their last bit.
    pub fn is_seen(&self) -> bool {
        self.components.iter().all(|c| c.lowest == [0; 64])
    }

    /// What a scan is of, by what ends its header, and the lowest bit of it; `None` for what no scan of such a picture is.
    fn pass(&self, end: &[u8], components: usize) -> Option<(Pass, u8)> {
        if !self.is_progressive {
            return Some((Pass::All, 0));
        }
        let &[from, to, bits] = end else { return None };
        let (is_first, lowest) = (bits >> 4 == 0, bits & 15);
        let pass = match (from, to, is_first) {
            (0, 0, true) => Pass::Mean,
            (0, 0, false) => Pass::MeanBit,
            (1..=63, 1..=63, _) if from > to || components != 1 => return None,
            (1..=63, 1..=63, true) => Pass::Band(from.into(), to.into()),
            (1..=63, 1..=63, false) => Pass::BandBit(from.into(), to.into()),
            _ => return None,
        };
        Some((pass, lowest))
    }

    /// Passes over the blocks of a scan that begins at `data`; how many bytes they take, `None` where its tables are not known.
    pub fn walk(
        &mut self,
        header: &[u8],
        dc: &[Option<Table>],
        ac: &[Option<Table>],
        restart: usize,
        data: &[u8],
    ) -> Result<Option<usize>, &'static str> {
        let Some((count, rest)) = header.split_first() else { return Ok(None) };
        let Some((named, end)) = rest.split_at_checked(2 * usize::from(*count)) else { return Ok(None) };
        let Some((pass, lowest)) = self.pass(end, (*count).into()) else { return Ok(None) };
        let Some((parts, units)) = self.parts(named, pass, dc, ac) else { return Ok(None) };
        self.scans += 1;
        if self.scans > MOST_SCANS {
            return Err(DAMAGED);
        }
        for part in &parts {
            let component = &mut self.components[part.component];
            if matches!(pass, Pass::Band(..) | Pass::BandBit(..)) {
                // The means come first (T.81, G.1.1.1.1): no memory is taken for blocks of which nothing was there yet.
                if component.lowest[0] == u8::MAX {
                    return Err(DAMAGED);
                }
                component.sent.resize(units, 0);
            }
            component.lowest[pass.coefficients()].fill(lowest);
        }
        let mut bits = Bits { data, at: 0, buffer: 0, count: 0, zeros: 0, run: 0 };
        for unit in 0..units {
            if restart > 0 && unit > 0 && unit % restart == 0 {
                bits.restart()?;
            }
            for part in &parts {
                for _ in 0..part.blocks {
                    let sent = self.components[part.component].sent.get_mut(unit);
                    bits.pass_over_block(pass, part, sent)?;
                }
            }
            if bits.overread() > LEFT_OUT {
                return Err(CUT);
            }
        }
        Ok(Some(bits.passed()))
    }

    /// The components of a scan, and how many units it has; `None` where their tables are not known.
    fn parts<'a>(
        &self,
        named: &[u8],
        pass: Pass,
        dc: &'a [Option<Table>],
        ac: &'a [Option<Table>],
    ) -> Option<(Vec<Part<'a>>, usize)> {
        let most = |of: fn(&Component) -> usize| self.components.iter().map(of).max().unwrap_or(1);
        let (across, down) = (most(|c| c.across), most(|c| c.down));
        let (mut parts, mut units) = (Vec::new(), 0);
        for one in named.chunks_exact(2) {
            let index = self.components.iter().position(|c| c.id == one[0])?;
            let table = |of: &'a [Option<Table>], n: u8| of.get(usize::from(n)).and_then(Option::as_ref);
            let (dc, ac) = (table(dc, one[1] >> 4), table(ac, one[1] & 15));
            let (needs_dc, needs_ac) = pass.tables();
            if needs_dc && dc.is_none() || needs_ac && ac.is_none() {
                return None;
            }
            let component = &self.components[index];
            let blocks = if named.len() == 2 {
                // Alone, a component has no more blocks than it needs.
                let side = |length: usize, own: usize, most: usize| (length * own).div_ceil(most).div_ceil(8);
                units = side(self.width, component.across, across) * side(self.height, component.down, down);
                1
            } else {
                units = self.width.div_ceil(8 * across) * self.height.div_ceil(8 * down);
                component.across * component.down
            };
            parts.push(Part { component: index, blocks, dc, ac });
        }
        Some((parts, units))
    }
}

impl Pass {
    /// Whether it is written with codes for means, and with those for the others.
    fn tables(self) -> (bool, bool) {
        match self {
            Self::All => (true, true),
            Self::Mean => (true, false),
            Self::MeanBit => (false, false),
            Self::Band(..) | Self::BandBit(..) => (false, true),
        }
    }

    fn coefficients(self) -> std::ops::RangeInclusive<usize> {
        match self {
            Self::All => 0..=63,
            Self::Mean | Self::MeanBit => 0..=0,
            Self::Band(from, to) | Self::BandBit(from, to) => from as usize..=to as usize,
        }
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
    /// Blocks that follow without anything new of their band.
    run: u32,
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

    fn bit(&mut self) {
        if self.count == 0 {
            self.fill();
        }
        self.count -= 1;
    }

    /// How many blocks a run is of: so many bits behind its code.
    fn run_of(&mut self, bits: u8) -> u32 {
        self.count -= u32::from(bits);
        (1 << bits) + ((self.buffer >> self.count) as u32 & ((1 << bits) - 1))
    }

    fn pass_over_block(&mut self, pass: Pass, part: &Part<'_>, sent: Option<&mut u64>) -> Result<(), &'static str> {
        match (pass, part.dc, part.ac, sent) {
            (Pass::All, Some(dc), Some(ac), _) => self.pass_over_all(dc, ac),
            (Pass::Mean, Some(dc), ..) => {
                let bits = self.code(dc)?;
                self.pass_over(bits);
                Ok(())
            }
            (Pass::MeanBit, ..) => {
                self.bit();
                Ok(())
            }
            (Pass::Band(from, to), _, Some(ac), Some(sent)) => self.pass_over_band(ac, (from, to), sent),
            (Pass::BandBit(from, to), _, Some(ac), Some(sent)) => self.pass_over_bits_of(ac, (from, to), sent),
            _ => Err(DAMAGED),
        }
    }

    fn pass_over_all(&mut self, dc: &Table, ac: &Table) -> Result<(), &'static str> {
        let bits = self.code(dc)?;
        self.pass_over(bits);
        let mut k = 1;
        while k < 64 {
            let value = self.code(ac)?;
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

    /// The first bits of a band (T.81, G.1.2.2).
    fn pass_over_band(&mut self, ac: &Table, (from, to): (u32, u32), sent: &mut u64) -> Result<(), &'static str> {
        if self.run > 0 {
            self.run -= 1;
            return Ok(());
        }
        let mut k = from;
        while k <= to {
            let value = self.code(ac)?;
            match (value >> 4, value & 15) {
                (15, 0) => k += 16,
                (run, 0) => {
                    self.run = self.run_of(run) - 1;
                    break;
                }
                (run, bits) => {
                    k += u32::from(run);
                    if k > 63 {
                        return Err(DAMAGED);
                    }
                    *sent |= 1 << k;
                    self.pass_over(bits);
                    k += 1;
                }
            }
        }
        Ok(())
    }

    /// One more bit of a band (T.81, G.1.2.3): of each coefficient that is no zero so far, and those that become one.
    fn pass_over_bits_of(&mut self, ac: &Table, (from, to): (u32, u32), sent: &mut u64) -> Result<(), &'static str> {
        let mut k = from;
        while self.run == 0 && k <= to {
            let value = self.code(ac)?;
            let (mut zeros, bits) = (value >> 4, value & 15);
            if bits == 0 && zeros < 15 {
                self.run = self.run_of(zeros);
                break;
            }
            if bits > 0 {
                // Its sign.
                self.bit();
            }
            while k <= to {
                match (*sent >> k & 1, zeros) {
                    (1, _) => self.bit(),
                    (_, 0) => break,
                    _ => zeros -= 1,
                }
                k += 1;
            }
            if bits > 0 && k <= to {
                *sent |= 1 << k;
            }
            k += 1;
        }
        if self.run > 0 {
            self.run -= 1;
            (k..=to).filter(|k| *sent >> k & 1 == 1).for_each(|_| self.bit());
        }
        Ok(())
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
        (self.buffer, self.count, self.zeros, self.run) = (0, 0, 0, 0);
        Ok(())
    }
}
