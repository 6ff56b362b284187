//! MCAP (mcap.dev/spec, version 0): chunks of messages with an index of each, and a summary at the end. Without compression.
//!
//! Own lines instead of Foxglove's crate: that brings eleven others, and keeps no bound on what it writes.

use std::io::{Result, Write};

const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// Opcodes of the records.
const HEADER: u8 = 0x01;
const FOOTER: u8 = 0x02;
const SCHEMA: u8 = 0x03;
const CHANNEL: u8 = 0x04;
pub(super) const MESSAGE: u8 = 0x05;
pub(super) const CHUNK: u8 = 0x06;
const MESSAGE_INDEX: u8 = 0x07;
const CHUNK_INDEX: u8 = 0x08;
const STATISTICS: u8 = 0x0B;
const DATA_END: u8 = 0x0F;
/// Opcode and length before the content of every record.
const PREFIX: u64 = 9;

/// A record being put together: numbers are little-endian, texts and maps have a length of 32 bits before them.
struct Record(Vec<u8>);

impl Record {
    fn new(opcode: u8) -> Self {
        Self([&[opcode][..], &[0; 8]].concat())
    }

    fn put(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }

    fn u16(self, n: u16) -> Self {
        self.put(&n.to_le_bytes())
    }

    fn u32(self, n: u32) -> Self {
        self.put(&n.to_le_bytes())
    }

    fn u64(self, n: u64) -> Self {
        self.put(&n.to_le_bytes())
    }

    fn sized(self, bytes: &[u8]) -> Self {
        self.u32(bytes.len() as u32).put(bytes)
    }

    fn map(self, entries: &[(u16, u64)]) -> Self {
        let bytes: Vec<u8> =
            entries.iter().flat_map(|(k, v)| [&k.to_le_bytes()[..], &v.to_le_bytes()].concat()).collect();
        self.sized(&bytes)
    }

    fn bytes(mut self) -> Vec<u8> {
        let length = self.0.len() as u64 - PREFIX;
        self.0[1..PREFIX as usize].copy_from_slice(&length.to_le_bytes());
        self.0
    }
}

/// What a file holds of one channel.
#[derive(Default)]
struct Count {
    messages: u64,
    /// Times and places of its messages in the chunk.
    index: Vec<(u64, u64)>,
}

/// A file being written.
pub(super) struct Writer<W: Write> {
    out: W,
    /// Bytes written so far.
    at: u64,
    /// Schemas and channels, which the summary repeats.
    declared: Vec<u8>,
    channels: Vec<Count>,
    chunk: Vec<u8>,
    chunk_bytes: usize,
    times: Option<(u64, u64)>,
    all_times: Option<(u64, u64)>,
    /// A record for every chunk, for the summary.
    chunks: Vec<u8>,
    chunk_count: u32,
}

fn widened(times: Option<(u64, u64)>, time: u64) -> Option<(u64, u64)> {
    Some(times.map_or((time, time), |(first, last)| (first.min(time), last.max(time))))
}

impl<W: Write> Writer<W> {
    /// Begins a file of `channels`: topic, name of the schema, the JSON schema. Data wait in chunks of `chunk_bytes`.
    pub(super) fn new(out: W, channels: &[(&str, &str, String)], chunk_bytes: usize) -> Result<Self> {
        let mut declared = Vec::new();
        for (id, (topic, name, schema)) in (1..).zip(channels) {
            let schema =
                Record::new(SCHEMA).u16(id).sized(name.as_bytes()).sized(b"jsonschema").sized(schema.as_bytes());
            let channel = Record::new(CHANNEL).u16(id).u16(id).sized(topic.as_bytes()).sized(b"json").map(&[]);
            declared.extend([schema.bytes(), channel.bytes()].concat());
        }
        let mut writer = Self {
            out,
            at: 0,
            declared,
            channels: channels.iter().map(|_| Count::default()).collect(),
            chunk: Vec::with_capacity(chunk_bytes),
            chunk_bytes,
            times: None,
            all_times: None,
            chunks: Vec::new(),
            chunk_count: 0,
        };
        let library = concat!("dgtr ", env!("CARGO_PKG_VERSION")).as_bytes();
        writer.emit(&MAGIC)?;
        writer.emit(&Record::new(HEADER).sized(b"").sized(library).bytes())?;
        let declared = writer.declared.clone();
        writer.emit(&declared)?;
        Ok(writer)
    }

    fn emit(&mut self, bytes: &[u8]) -> Result<()> {
        self.at += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    /// Adds a message of a channel, by its place in the list; one that is not there is left out.
    pub(super) fn write(&mut self, channel: usize, time_ns: u64, data: &[u8]) -> Result<()> {
        let Some(count) = self.channels.get_mut(channel) else { return Ok(()) };
        count.messages += 1;
        count.index.push((time_ns, self.chunk.len() as u64));
        let message = Record::new(MESSAGE).u16(channel as u16 + 1).u32(count.messages as u32).u64(time_ns).u64(time_ns);
        self.chunk.extend(message.put(data).bytes());
        self.times = widened(self.times, time_ns);
        if self.chunk.len() >= self.chunk_bytes { self.flush() } else { Ok(()) }
    }

    /// Writes what waits, with its index.
    pub(super) fn flush(&mut self) -> Result<()> {
        let Some((first, last)) = self.times.take() else { return Ok(()) };
        let chunk_start = self.at;
        let size = self.chunk.len() as u64;
        // No checksum (0), no compression (an empty name).
        let head = Record::new(CHUNK).u64(first).u64(last).u64(size).u32(0).sized(b"").u64(size);
        let chunk = head.put(&self.chunk).bytes();
        self.emit(&chunk)?;
        let index_start = self.at;
        let mut offsets = Vec::with_capacity(self.channels.len());
        for (place, id) in (0..self.channels.len()).zip(1u16..) {
            let index = std::mem::take(&mut self.channels[place].index);
            if !index.is_empty() {
                offsets.push((id, self.at));
                let entries: Vec<u8> =
                    index.iter().flat_map(|(time, at)| [time.to_le_bytes(), at.to_le_bytes()].concat()).collect();
                self.emit(&Record::new(MESSAGE_INDEX).u16(id).sized(&entries).bytes())?;
            }
        }
        let index_bytes = self.at - index_start;
        let index = Record::new(CHUNK_INDEX).u64(first).u64(last).u64(chunk_start).u64(chunk.len() as u64);
        let index = index.map(&offsets).u64(index_bytes).sized(b"").u64(size).u64(size);
        self.chunks.extend(index.bytes());
        self.chunk_count += 1;
        self.all_times = widened(widened(self.all_times, first), last);
        self.chunk.clear();
        self.out.flush()
    }

    /// Ends the file: the rest, the summary, and where that is.
    pub(super) fn finish(&mut self) -> Result<()> {
        self.flush()?;
        self.emit(&Record::new(DATA_END).u32(0).bytes())?;
        let summary = self.at;
        let (first, last) = self.all_times.unwrap_or_default();
        let counts: Vec<(u16, u64)> = (1..).zip(&self.channels).map(|(id, count)| (id, count.messages)).collect();
        let count = counts.len();
        let statistics = Record::new(STATISTICS)
            .u64(counts.iter().map(|(_, n)| n).sum())
            .u16(count as u16)
            .u32(count as u32)
            .u32(0)
            .u32(0)
            .u32(self.chunk_count)
            .u64(first)
            .u64(last)
            .map(&counts);
        // Records of a kind stand together.
        let kind = |opcode: u8| split(&self.declared).filter(|r| r[0] == opcode).collect::<Vec<_>>().concat();
        let all = [kind(SCHEMA), kind(CHANNEL), statistics.bytes(), std::mem::take(&mut self.chunks)].concat();
        self.emit(&all)?;
        self.emit(&Record::new(FOOTER).u64(summary).u64(0).u32(0).bytes())?;
        self.emit(&MAGIC)?;
        self.out.flush()
    }

    /// What it is written to.
    pub(super) fn get_ref(&self) -> &W {
        &self.out
    }
}

/// Whole records one after the other; half a one at the end is passed over.
pub(super) fn split(bytes: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = bytes;
    std::iter::from_fn(move || {
        let length: [u8; 8] = rest.get(1..PREFIX as usize)?.try_into().ok()?;
        let end = usize::try_from(u64::from_le_bytes(length)).ok()?.checked_add(PREFIX as usize)?;
        let record = rest.get(..end)?;
        rest = &rest[end..];
        Some(record)
    })
}
