//! A micro:bit in QEMU whose flash keeps its contents over resets, with a debugger: it stops at functions of the firmware, and
//! loses its power there.
//!
//! QEMU writes what it gets by `-kernel` again at each reset. So the board starts halted and blank, and the debugger writes its
//! flash.

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::ops::Range;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;

use object::read::elf::{FileHeader, ProgramHeader};
use rustix::event::{PollFd, PollFlags, poll};

use super::board::find;
use super::build::{ancestor, assert_fresh};
use super::{PATIENCE, Process, Scratch, until};

/// Bytes that one packet of QEMU's debugger can carry.
const PACKET: usize = 1024;

const DIGITS: &[u8; 16] = b"0123456789abcdef";

/// The flash of a micro:bit.
pub const FLASH: usize = 256 << 10;

/// A micro:bit with a debugger. It is switched off when this is dropped.
#[derive(Debug)]
pub struct DebuggedBoard {
    /// Its serial port.
    pub serial: UnixStream,
    debugger: UnixStream,
    control: BufReader<UnixStream>,
    /// Bytes of the debugger that are not handled yet.
    said: Vec<u8>,
    stops: BTreeSet<u64>,
    is_running: bool,
    process: Process,
    _scratch: Scratch,
}

impl DebuggedBoard {
    /// A board with a blank flash, which is halted.
    #[track_caller]
    pub fn start() -> Self {
        let scratch = Scratch::new();
        let mut qemu = Command::new("qemu-system-arm");
        qemu.args(["-M", "microbit", "-nographic", "-monitor", "none", "-S"]);
        for (option, name) in [("-gdb", "gdb"), ("-qmp", "qmp"), ("-serial", "serial")] {
            let path = scratch.path(name);
            qemu.arg(option)
                .arg(format!("unix:{},server=on,wait=off", path.display()));
        }
        let process = Process::start(&mut qemu);
        let [debugger, control, serial] = ["gdb", "qmp", "serial"].map(|name| {
            let stream = until("QEMU", PATIENCE, || {
                UnixStream::connect(scratch.path(name)).ok()
            });
            stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
            stream
        });
        serial.set_nonblocking(true).expect("a socket");
        debugger.set_nonblocking(true).expect("a socket");
        let mut board = Self {
            serial,
            debugger,
            control: BufReader::new(control),
            said: Vec::new(),
            stops: BTreeSet::new(),
            is_running: false,
            process,
            _scratch: scratch,
        };
        board.wait_control("\"QMP\"");
        board.control("qmp_capabilities", "\"return\"");
        board.write_flash(0, &[0xFF; FLASH]);
        board
    }

    /// Writes the flash of the halted board, whatever it holds.
    #[track_caller]
    pub fn write_flash(&mut self, address: usize, bytes: &[u8]) {
        for (at, bytes) in (address..).step_by(PACKET).zip(bytes.chunks(PACKET)) {
            let digits = bytes.iter().flat_map(|byte| [byte >> 4, byte & 15]);
            let digits = digits.map(|digit| char::from(DIGITS[usize::from(digit)]));
            let digits: String = digits.collect();
            assert_eq!(
                self.ask(&format!("M{at:x},{:x}:{digits}", bytes.len())),
                "OK"
            );
        }
    }

    /// Reads the memory of the halted board.
    #[track_caller]
    pub fn read_memory(&mut self, addresses: Range<usize>) -> Vec<u8> {
        let mut memory = Vec::new();
        for at in addresses.clone().step_by(PACKET) {
            let count = PACKET.min(addresses.end - at);
            memory.extend(bytes(&self.ask(&format!("m{at:x},{count:x}"))));
        }
        memory
    }

    /// Stops the halted board's firmware at exactly these addresses from now on.
    #[track_caller]
    pub fn set_stops(&mut self, addresses: &BTreeSet<u64>) {
        let before = std::mem::replace(&mut self.stops, addresses.clone());
        for address in before.difference(addresses) {
            assert_eq!(self.ask(&format!("z0,{address:x},2")), "OK");
        }
        for address in addresses.difference(&before) {
            assert_eq!(self.ask(&format!("Z0,{address:x},2")), "OK");
        }
    }

    /// The address at which the firmware has stopped, and the first two arguments of the function there.
    #[track_caller]
    pub fn stopped_at(&mut self) -> (u64, [u32; 2]) {
        let registers = bytes(&self.ask("g"));
        let register = |number: usize| {
            let bytes = &registers[4 * number..][..4];
            u32::from_le_bytes(bytes.try_into().expect("4 bytes"))
        };
        (register(15).into(), [register(0), register(1)])
    }

    /// Lets the halted board run: on from where it has stopped.
    #[track_caller]
    pub fn run(&mut self) {
        // A step first, since it would stop at the same place again.
        assert!(self.ask("s").starts_with("T05"));
        self.send("c");
        self.is_running = true;
    }

    /// Waits until the board stops, which gives `true`, or there are bytes at the serial port, or for so many milliseconds.
    #[track_caller]
    pub fn wait(&mut self, limit_ms: u32) -> bool {
        if self.packet(false).is_some() {
            self.is_running = false;
            return true;
        }
        self.await_input(limit_ms, true);
        let stopped = self.packet(false).is_some();
        self.is_running &= !stopped;
        stopped
    }

    /// Waits for bytes of the debugger, or of the serial port.
    fn await_input(&self, limit_ms: u32, serial: bool) {
        let mut streams = vec![PollFd::new(&self.debugger, PollFlags::IN)];
        if serial {
            streams.push(PollFd::new(&self.serial, PollFlags::IN));
        }
        let limit = rustix::event::Timespec {
            tv_sec: (limit_ms / 1000).into(),
            tv_nsec: i64::from(limit_ms % 1000) * 1_000_000,
        };
        let ready = poll(&mut streams, Some(&limit)).expect("sockets");
        assert!(ready > 0 || serial, "QEMU does not answer");
    }

    /// Halts the board where it is.
    #[track_caller]
    pub fn halt(&mut self) {
        if self.is_running {
            self.debugger.write_all(&[3]).expect("QEMU");
            let stopped = self.packet(true).expect("QEMU halts");
            assert!(stopped.starts_with('T'), "{stopped}");
            self.is_running = false;
        }
    }

    /// Takes the power away from the halted board and gives it back; it is still halted.
    #[track_caller]
    pub fn cut_power(&mut self) {
        assert!(!self.is_running);
        // The firmware's own resets are told, too.
        self.control("system_reset", "host-qmp-system-reset");
        // The stop of the moment before, if any, is no longer one.
        while self.packet(false).is_some() {}
        let mut stale = [0; 256];
        while self.serial.read(&mut stale).is_ok_and(|count| count > 0) {}
    }

    #[track_caller]
    fn control(&mut self, command: &str, answer: &str) {
        let line = format!("{{\"execute\": \"{command}\"}}\n");
        self.control
            .get_mut()
            .write_all(line.as_bytes())
            .expect("QEMU");
        self.wait_control(answer);
    }

    #[track_caller]
    fn wait_control(&mut self, answer: &str) {
        let mut line = String::new();
        while !line.contains(answer) {
            line.clear();
            assert!(self.control.read_line(&mut line).expect("QEMU") > 0);
        }
    }

    #[track_caller]
    fn ask(&mut self, question: &str) -> String {
        self.send(question);
        self.packet(true).expect("an answer")
    }

    #[track_caller]
    fn send(&mut self, text: &str) {
        let sum = text.bytes().fold(0_u8, u8::wrapping_add);
        let packet = format!("${text}#{sum:02x}");
        self.debugger.write_all(packet.as_bytes()).expect("QEMU");
    }

    /// The debugger's next packet; without `wait` only if it is there.
    fn packet(&mut self, wait: bool) -> Option<String> {
        loop {
            let end = self.said.iter().position(|byte| *byte == b'#');
            if let Some(end) = end.filter(|end| self.said.len() > end + 2) {
                let packet: Vec<u8> = self.said.drain(..end + 3).collect();
                let begin = packet
                    .iter()
                    .position(|byte| *byte == b'$')
                    .expect("a packet");
                // Until then QEMU does not take the byte that halts.
                self.debugger.write_all(b"+").expect("QEMU");
                return Some(String::from_utf8_lossy(&packet[begin + 1..end]).into_owned());
            }
            let mut buffer = [0; 4096];
            let read = self.debugger.read(&mut buffer);
            match read {
                Ok(0) => panic!("QEMU has ended: {}", self.process.stderr()),
                Ok(count) => self.said.extend(&buffer[..count]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    if !wait {
                        return None;
                    }
                    self.await_input(PATIENCE.as_millis() as u32, false);
                }
                Err(error) => panic!("QEMU's debugger: {error}"),
            }
        }
    }
}

/// Bytes in hexadecimal digits.
fn bytes(digits: &str) -> Vec<u8> {
    let pairs = digits.as_bytes().chunks(2);
    let pairs = pairs.map(|pair| {
        str::from_utf8(pair)
            .ok()
            .and_then(|pair| u8::from_str_radix(pair, 16).ok())
    });
    pairs
        .map(|byte| byte.unwrap_or_else(|| panic!("QEMU answers {digits}")))
        .collect()
}

/// An image of `examples/firmware` for the micro:bit.
#[derive(Debug)]
pub struct FlashImage {
    elf: Vec<u8>,
}

impl FlashImage {
    /// # Panics
    /// When it is missing or stale.
    #[track_caller]
    pub fn built(name: &str) -> Self {
        let path = ancestor(3)
            .join("firmware/thumbv6m-none-eabi/release")
            .join(name);
        assert_fresh(&path, "cargo xtask firmware microbit");
        Self {
            elf: fs::read(&path).expect("an image"),
        }
    }

    /// The bytes in the flash, as `objcopy -O binary` makes them, and the address of the first one.
    #[track_caller]
    pub fn bytes(&self) -> (usize, Vec<u8>) {
        let header = object::elf::FileHeader32::<object::LittleEndian>::parse(self.elf.as_slice());
        let header = header.expect("an ELF file of 32 bits");
        let headers = header.program_headers(object::LittleEndian, self.elf.as_slice());
        let segments = headers.expect("its segments").iter().filter_map(|header| {
            let bytes = header
                .data(object::LittleEndian, self.elf.as_slice())
                .ok()?;
            let at = header.p_paddr(object::LittleEndian) as usize;
            (!bytes.is_empty()).then_some((at, bytes))
        });
        let segments: Vec<_> = segments.collect();
        let begin = segments.iter().map(|(at, _)| *at).min().expect("a segment");
        let end = segments
            .iter()
            .map(|(at, bytes)| at + bytes.len())
            .max()
            .expect("a segment");
        let mut flash = vec![0; end - begin];
        for (at, bytes) in segments {
            flash[at - begin..][..bytes.len()].copy_from_slice(bytes);
        }
        (begin, flash)
    }

    /// Where a symbol is.
    #[track_caller]
    pub fn symbol(&self, name: &str) -> u64 {
        let address = find(&self.elf, name).unwrap_or_else(|| panic!("no {name}"));
        // Without the bit that says Thumb.
        address & !1
    }
}

/// The package of the micro:bit.
pub fn microbit() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/firmware/microbit")
}
