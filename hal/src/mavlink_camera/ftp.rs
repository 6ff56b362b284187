//! A MAVLink FTP server of one file, which lies in memory and can only be read: sessions, offsets and answers of a fixed size.
//! Nothing of a file system is behind it.

use heapless::Deque;

use super::definition::crc32;
use crate::mavlink::dialect::{FILE_TRANSFER_PROTOCOL_DATA, MavFtpErr, MavFtpOpcode};

/// Name of the file; leading slashes of a path are passed over, as clients differ in how many they send.
pub(super) const PATH: &str = "definition.xml";
/// Clients that read at the same time.
const SESSIONS: usize = 2;
/// A session that nothing was heard of for so long may be taken by another client (ArduPilot's FTP_SESSION_TIMEOUT).
const IDLE_NS: u64 = 3_000_000_000;
/// Answers waiting to be sent; whoever asks for more at once asks again.
const ANSWERS: usize = 4;
/// Payload: header, then data.
const HEADER: usize = 12;
const DATA: usize = 251 - HEADER;

/// Who asks: system and component.
pub(super) type Client = (u8, u8);

/// A request, or the answer to one.
#[derive(Clone, Copy, Debug)]
struct Packet {
    sequence: u16,
    session: u8,
    opcode: u8,
    asked: u8,
    burst_over: bool,
    offset: u32,
    size: u8,
    data: [u8; DATA],
}

impl Packet {
    /// `None` when it says that it holds more than there is room for.
    fn read(payload: &[u8; HEADER + DATA]) -> Option<Self> {
        let [s0, s1, session, opcode, size, asked, over, _, o0, o1, o2, o3, data @ ..] = *payload;
        let (sequence, offset) = (u16::from_le_bytes([s0, s1]), u32::from_le_bytes([o0, o1, o2, o3]));
        let packet = Self { sequence, session, opcode, asked, burst_over: over != 0, offset, size, data };
        (usize::from(size) <= DATA).then_some(packet)
    }

    fn payload(&self) -> [u8; HEADER + DATA] {
        let mut payload = [0; HEADER + DATA];
        payload[..2].copy_from_slice(&self.sequence.to_le_bytes());
        payload[2..8].copy_from_slice(&[self.session, self.opcode, self.size, self.asked, self.burst_over.into(), 0]);
        payload[8..HEADER].copy_from_slice(&self.offset.to_le_bytes());
        payload[HEADER..].copy_from_slice(&self.data);
        payload
    }

    /// The path in a request.
    fn path(&self) -> Option<&str> {
        let bytes = self.data.get(..usize::from(self.size))?;
        let end = bytes.iter().position(|b| *b == 0).unwrap_or(bytes.len());
        core::str::from_utf8(&bytes[..end]).ok().map(|path| path.trim_start_matches('/'))
    }

    /// The answer to this request, with `data`.
    fn answer(&self, data: &[u8]) -> Self {
        let mut answer = Self {
            sequence: self.sequence.wrapping_add(1),
            opcode: MavFtpOpcode::MAV_FTP_OPCODE_ACK as u8,
            asked: self.opcode,
            burst_over: false,
            data: [0; DATA],
            size: 0,
            ..*self
        };
        for (to, from) in answer.data.iter_mut().zip(data) {
            (*to, answer.size) = (*from, answer.size + 1);
        }
        answer
    }

    fn refusal(&self, error: MavFtpErr) -> Self {
        Self { opcode: MavFtpOpcode::MAV_FTP_OPCODE_NAK as u8, ..self.answer(&[error as u8]) }
    }
}

/// An open file.
#[derive(Clone, Copy, Debug)]
struct Session {
    client: Client,
    id: u8,
    used_ns: u64,
    /// The request of a burst, moved on with every packet that was sent.
    burst: Option<Packet>,
}

/// The server.
#[derive(Debug, Default)]
pub(super) struct FileServer {
    sessions: [Option<Session>; SESSIONS],
    answers: Deque<(Client, Packet), ANSWERS>,
}

impl FileServer {
    /// Takes a request for `file`.
    pub(super) fn handle(&mut self, m: &FILE_TRANSFER_PROTOCOL_DATA, client: Client, file: &[u8], now_ns: u64) {
        let answer = match Packet::read(&m.payload) {
            Some(request) => match self.respond(&request, client, file, now_ns) {
                Some(response) => response.unwrap_or_else(|error| request.refusal(error)),
                None => return,
            },
            None => {
                let mut payload = m.payload;
                payload[4] = 0;
                let Some(request) = Packet::read(&payload) else { return };
                request.refusal(MavFtpErr::MAV_FTP_ERR_INVALIDDATASIZE)
            }
        };
        // A client that asks faster than it is answered asks again.
        let _ = self.answers.push_back((client, answer));
    }

    /// What is answered at once; `None` when packets of a burst are the answer.
    fn respond(
        &mut self,
        request: &Packet,
        client: Client,
        file: &[u8],
        now_ns: u64,
    ) -> Option<Result<Packet, MavFtpErr>> {
        use MavFtpErr as E;
        const NONE: u8 = MavFtpOpcode::MAV_FTP_OPCODE_NONE as u8;
        const TERMINATE: u8 = MavFtpOpcode::MAV_FTP_OPCODE_TERMINATESESSION as u8;
        const RESET: u8 = MavFtpOpcode::MAV_FTP_OPCODE_RESETSESSION as u8;
        const LIST: u8 = MavFtpOpcode::MAV_FTP_OPCODE_LISTDIRECTORY as u8;
        const OPEN: u8 = MavFtpOpcode::MAV_FTP_OPCODE_OPENFILERO as u8;
        const READ: u8 = MavFtpOpcode::MAV_FTP_OPCODE_READFILE as u8;
        const BURST: u8 = MavFtpOpcode::MAV_FTP_OPCODE_BURSTREADFILE as u8;
        const CHECKSUM: u8 = MavFtpOpcode::MAV_FTP_OPCODE_CALCFILECRC as u8;
        const FIRST_WRITE: u8 = MavFtpOpcode::MAV_FTP_OPCODE_CREATEFILE as u8;
        const LAST_WRITE: u8 = MavFtpOpcode::MAV_FTP_OPCODE_RENAME as u8;
        Some(match request.opcode {
            NONE => Ok(request.answer(&[])),
            // Of a session that is over it is the repetition of a request whose answer was lost.
            TERMINATE => {
                self.close(|session| session.client == client && session.id == request.session);
                Ok(request.answer(&[]))
            }
            // The client's own: another one may be reading.
            RESET => {
                self.close(|session| session.client == client);
                Ok(request.answer(&[]))
            }
            LIST => match request.path() {
                Some("" | ".") if request.offset == 0 => Ok(list(request, file)),
                Some("" | ".") => Err(E::MAV_FTP_ERR_EOF),
                _ => Err(E::MAV_FTP_ERR_FILENOTFOUND),
            },
            OPEN if request.path() != Some(PATH) => Err(E::MAV_FTP_ERR_FILENOTFOUND),
            OPEN => match self.open(client, request.session, now_ns) {
                true => Ok(request.answer(&(file.len() as u32).to_le_bytes())),
                false => Err(E::MAV_FTP_ERR_NOSESSIONSAVAILABLE),
            },
            CHECKSUM if request.path() != Some(PATH) => Err(E::MAV_FTP_ERR_FILENOTFOUND),
            CHECKSUM => Ok(request.answer(&crc32(file).to_le_bytes())),
            READ | BURST => {
                let ours = |s: &&mut Session| s.client == client && s.id == request.session;
                let Some(session) = self.sessions.iter_mut().flatten().find(ours) else {
                    return Some(Err(E::MAV_FTP_ERR_INVALIDSESSION));
                };
                session.used_ns = now_ns;
                let piece = piece(file, request);
                match (piece.is_empty(), request.opcode) {
                    (true, _) => Err(E::MAV_FTP_ERR_EOF),
                    (false, READ) => Ok(request.answer(piece)),
                    (false, _) => {
                        session.burst = Some(*request);
                        return None;
                    }
                }
            }
            FIRST_WRITE..=LAST_WRITE => Err(E::MAV_FTP_ERR_FILEPROTECTED),
            _ => Err(E::MAV_FTP_ERR_UNKNOWNCOMMAND),
        })
    }

    /// Opens the file for `client`; the session has the id that it chose, as with ArduPilot. False: others are reading.
    fn open(&mut self, client: Client, id: u8, now_ns: u64) -> bool {
        let own = self.sessions.iter().position(|s| s.is_some_and(|s| s.client == client));
        let free = |s: &Option<Session>| s.is_none_or(|s| now_ns.saturating_sub(s.used_ns) > IDLE_NS);
        let Some(place) = own.or_else(|| self.sessions.iter().position(free)) else { return false };
        self.sessions[place] = Some(Session { client, id, used_ns: now_ns, burst: None });
        true
    }

    fn close(&mut self, which: impl Fn(&Session) -> bool) {
        for session in &mut self.sessions {
            *session = session.filter(|session| !which(session));
        }
    }

    /// The next answer, and to whom. Packets of a burst only when it `may_burst`.
    pub(super) fn next(&mut self, file: &[u8], may_burst: bool) -> Option<FILE_TRANSFER_PROTOCOL_DATA> {
        let (client, packet) = match self.answers.pop_front() {
            Some(answer) => answer,
            None if may_burst => self.sessions.iter_mut().flatten().find_map(|session| session.next_packet(file))?,
            None => return None,
        };
        let (target_system, target_component) = client;
        let payload = packet.payload();
        Some(FILE_TRANSFER_PROTOCOL_DATA { target_network: 0, target_system, target_component, payload })
    }

    /// A burst waits for its next packet.
    pub(super) fn bursts(&self) -> bool {
        self.sessions.iter().flatten().any(|session| session.burst.is_some())
    }
}

impl Session {
    /// The next packet of the burst.
    fn next_packet(&mut self, file: &[u8]) -> Option<(Client, Packet)> {
        let mut request = self.burst.take()?;
        let piece = piece(file, &request);
        let end = request.offset.saturating_add(piece.len() as u32);
        let burst_over = end as usize >= file.len();
        let packet = Packet { burst_over, ..request.answer(piece) };
        if !burst_over {
            (request.offset, request.sequence) = (end, packet.sequence);
            self.burst = Some(request);
        }
        Some((self.client, packet))
    }
}

/// The only folder's only entry.
fn list(request: &Packet, file: &[u8]) -> Packet {
    use core::fmt::Write;
    let mut entry = heapless::Vec::<u8, 64>::new();
    // 13 bytes and a number.
    let _ = write!(entry, "F{PATH}\t{}\0", file.len());
    request.answer(&entry)
}

/// What `request` asks for of `file`; empty behind its end. A size of 0 is as much as there is room for (ArduPilot).
fn piece<'a>(file: &'a [u8], request: &Packet) -> &'a [u8] {
    let most = if request.size == 0 { DATA } else { usize::from(request.size) };
    let rest = usize::try_from(request.offset).ok().and_then(|offset| file.get(offset..)).unwrap_or(&[]);
    &rest[..rest.len().min(most)]
}

#[cfg(test)]
mod tests {
    use std::vec::Vec;

    use super::*;

    const S: u64 = 1_000_000_000;
    const FILE: [u8; 600] = [7; 600];
    const ACK: u8 = 128;
    const NAK: u8 = 129;

    fn ask(server: &mut FileServer, client: Client, head: [u8; 5], offset: u32, data: &[u8], now_ns: u64) {
        let [sequence, session, opcode, size, _] = head;
        let mut payload = [0; 251];
        payload[..5].copy_from_slice(&[sequence, 0, session, opcode, size]);
        payload[8..12].copy_from_slice(&offset.to_le_bytes());
        payload[12..12 + data.len()].copy_from_slice(data);
        let m = FILE_TRANSFER_PROTOCOL_DATA { target_network: 0, target_system: 1, target_component: 100, payload };
        server.handle(&m, client, &FILE, now_ns);
    }

    /// Opcode and data of what is answered.
    fn answers(server: &mut FileServer) -> Vec<(u8, Vec<u8>)> {
        let all = core::iter::from_fn(|| server.next(&FILE, true));
        all.map(|m| (m.payload[3], m.payload[12..12 + usize::from(m.payload[4])].to_vec())).collect()
    }

    fn one(server: &mut FileServer, opcode: u8, session: u8, offset: u32, data: &[u8]) -> (u8, Vec<u8>) {
        ask(server, (255, 190), [1, session, opcode, data.len() as u8, 0], offset, data, S);
        let mut all = answers(server);
        assert_eq!(all.len(), 1, "{all:?}");
        all.remove(0)
    }

    #[test]
    fn the_one_file_is_listed_opened_read_and_closed() {
        let mut server = FileServer::default();
        assert_eq!(one(&mut server, 3, 0, 0, b"/"), (ACK, b"Fdefinition.xml\t600\0".to_vec()));
        assert_eq!(one(&mut server, 3, 0, 1, b"/"), (NAK, [6].to_vec()), "the end of the list");
        assert_eq!(one(&mut server, 5, 0, 0, &[]).1, [4], "nothing is open yet");
        assert_eq!(one(&mut server, 4, 0, 0, b"//definition.xml\0"), (ACK, 600u32.to_le_bytes().to_vec()));
        assert_eq!(one(&mut server, 5, 0, 590, &[0; 20]), (ACK, FILE[590..].to_vec()));
        assert_eq!(one(&mut server, 5, 0, 600, &[0; 20]), (NAK, [6].to_vec()));
        assert_eq!(one(&mut server, 5, 0, u32::MAX, &[0; 20]), (NAK, [6].to_vec()));
        assert_eq!(one(&mut server, 14, 0, 0, b"definition.xml").1, crc32(&FILE).to_le_bytes());
        assert_eq!(one(&mut server, 1, 0, 0, &[]).0, ACK);
        assert_eq!(one(&mut server, 5, 0, 0, &[]).1, [4], "closed");
    }

    #[test]
    fn a_burst_is_the_rest_of_the_file_with_growing_numbers_and_an_end() {
        let mut server = FileServer::default();
        one(&mut server, 4, 3, 0, b"definition.xml");
        ask(&mut server, (255, 190), [200, 3, 15, 239, 0], 100, &[], S);
        assert!(server.bursts() && server.next(&FILE, false).is_none(), "not before it may");
        let sent: Vec<_> = core::iter::from_fn(|| server.next(&FILE, true)).collect();
        let told: Vec<_> = sent.iter().map(|m| (m.payload[0], m.payload[4], m.payload[6], m.payload[8])).collect();
        // Sequence, bytes, whether it is the last, low byte of the offset.
        assert_eq!(told, [(201, 239, 0, 100), (202, 239, 0, (339 % 256) as u8), (203, 22, 1, (578 % 256) as u8)]);
        assert_eq!(one(&mut server, 15, 3, 600, &[]), (NAK, [6].to_vec()));
    }

    #[test]
    fn nothing_else_is_reachable_and_nothing_is_written() {
        let mut server = FileServer::default();
        for path in
            [&b"/etc/passwd"[..], b"../definition.xml", b"definition.xml/..", b"@SYS/param.pck", b"", b"\xFF\xFE"]
        {
            assert_eq!(one(&mut server, 4, 0, 0, path), (NAK, [10].to_vec()), "{path:?}");
            assert_eq!(one(&mut server, 14, 0, 0, path), (NAK, [10].to_vec()), "{path:?}");
        }
        assert_eq!(one(&mut server, 3, 0, 0, b"/etc"), (NAK, [10].to_vec()));
        for opcode in 6..=13 {
            assert_eq!(one(&mut server, opcode, 0, 0, b"definition.xml"), (NAK, [9].to_vec()), "{opcode}");
        }
        for opcode in [16, 99, 128, 255] {
            assert_eq!(one(&mut server, opcode, 0, 0, b"definition.xml"), (NAK, [7].to_vec()), "{opcode}");
        }
        ask(&mut server, (255, 190), [1, 0, 4, 240, 0], 0, b"definition.xml", S);
        assert_eq!(answers(&mut server), [(NAK, [3].to_vec())], "more than a packet holds");
    }

    #[test]
    fn a_third_reader_waits_until_one_has_fallen_silent() {
        let mut server = FileServer::default();
        let open = |server: &mut FileServer, client, now_ns| {
            ask(server, client, [1, 0, 4, 14, 0], 0, b"definition.xml", now_ns);
            answers(server).remove(0)
        };
        assert_eq!(open(&mut server, (255, 190), S).0, ACK);
        assert_eq!(open(&mut server, (254, 190), 3 * S).0, ACK);
        assert_eq!(open(&mut server, (253, 190), 4 * S), (NAK, [5].to_vec()));
        assert_eq!(open(&mut server, (255, 190), 4 * S).0, ACK, "its own session is opened again");
        assert_eq!(open(&mut server, (253, 190), 7 * S).0, ACK);
    }
}
