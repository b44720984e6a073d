//! Firmware on a board in QEMU: the images of `examples/firmware`, with the serial port at a TCP port, and pins that a
//! test reads and writes.

use std::cell::RefCell;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::ops::Range;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;

use object::{Object, ObjectSymbol};

use super::build::{ancestor, assert_fresh};
use super::{PATIENCE, Process, Scratch, reserve_port, until};

/// The byte that marks unused stack.
const PAINT: u8 = 0xC5;

/// Board, target, machine.
const BOARDS: &str = include_str!("../../../examples/firmware/boards.txt");

/// The words of the panel (`examples/firmware/board-support/src/panel.rs`), in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pin {
    /// 1 presses the stage's limit switch.
    Limit,
    /// 1 presses the emergency button.
    Stop,
    /// 1 presses the button that ends an emergency stop.
    Resume,
    /// The gripper's pulse in µs, 0 when there is none.
    Pulse,
    /// Where the stage is: steps above its switch.
    Place,
    /// 1 when the lamp is lit.
    Lamp,
}

/// A running board. It is switched off when this is dropped.
#[derive(Debug)]
pub struct Board {
    /// QEMU.
    pub process: Process,
    /// The TCP port of its serial port.
    pub port: u16,
    /// The TCP port at which its network port is reached, if it has one.
    pub network: u16,
    /// Its firmware's ELF file.
    pub elf: PathBuf,
    /// The address of the pins, if the image has some.
    panel: Option<u64>,
    /// From the end of the static data to the start of the stack.
    stack: Range<u64>,
    scratch: Scratch,
    probe: RefCell<BufReader<UnixStream>>,
}

impl Board {
    /// A board by its name in `boards.txt`.
    ///
    /// # Panics
    /// When its image is missing. A test is never skipped silently.
    #[track_caller]
    pub fn start(name: &str) -> Self {
        Self::with_image(name, name)
    }

    /// The same with another image of its package.
    #[track_caller]
    pub fn with_image(name: &str, image: &str) -> Self {
        Self::launch(name, image, None)
    }

    /// The same with a network port: this TCP port of the board is reachable at [`network`](Self::network).
    #[track_caller]
    pub fn with_network(name: &str, image: &str, port: u16) -> Self {
        Self::launch(name, image, Some(port))
    }

    #[track_caller]
    fn launch(name: &str, image: &str, served: Option<u16>) -> Self {
        let lines = BOARDS.lines().map(|line| line.split_whitespace().collect());
        let mut lines = lines.filter(|words: &Vec<&str>| words.first() == Some(&name));
        let words = lines.next().expect("a board of boards.txt");
        let [_, target, program, machine @ ..] = words.as_slice() else {
            panic!("QEMU does not run {name}");
        };
        // Where `cargo xtask firmware` builds it: <target>/firmware.
        let elf = ancestor(3).join("firmware").join(target);
        let elf = elf.join("release").join(image);
        // `cargo xtask test --only c` links the images of firmware in C, which Cargo knows nothing of.
        if !image.ends_with("-c") && !image.ends_with("-cpp") {
            assert_fresh(&elf, "cargo xtask firmware");
        }
        let image = fs::read(&elf).unwrap_or_else(|error| {
            panic!("{}: {error}: run `cargo xtask firmware`", elf.display())
        });

        let scratch = Scratch::new();
        let socket =
            |name: &str| format!("unix:{},server=on,wait=off", scratch.path(name).display());
        let mut qemu = Command::new(program);
        qemu.args(machine).arg("-nographic");
        qemu.args(["-monitor", &socket("monitor")]);
        // Reads and writes memory while the machine runs.
        qemu.args(["-qtest", &socket("probe"), "-qtest-log", "none"]);
        qemu.arg("-kernel").arg(&elf);
        // The stack's memory is painted before the board starts.
        let heap = ["__sheap", "_sheap"]
            .iter()
            .find_map(|name| find(&image, name));
        let top = find(&image, "_stack_start").expect("a stack");
        let stack = heap.expect("the end of what is static").next_multiple_of(4)..top;
        // A large RAM is not used to its end.
        let stack = stack.start.max(stack.end - 16384)..stack.end;
        let paint = vec![PAINT; usize::try_from(stack.end - stack.start).expect("a size")];
        fs::write(scratch.path("paint"), paint).expect("a file");
        qemu.arg("-device").arg(format!(
            "loader,file={},addr={:#x},force-raw=on",
            scratch.path("paint").display(),
            stack.start
        ));
        let (process, probe, [port, network]) = power_on(&qemu, &scratch.path("probe"), served);
        Self {
            process,
            port,
            network,
            elf,
            panel: find(&image, "PANEL"),
            stack,
            probe: RefCell::new(probe),
            scratch,
        }
    }

    /// For `ztl gateway --device`.
    pub fn device(&self) -> String {
        format!("desk=tcp:127.0.0.1:{}", self.port)
    }

    /// Reads a pin.
    #[track_caller]
    pub fn read(&self, pin: Pin) -> u32 {
        self.read_word(self.address(pin))
    }

    /// Reads a word of memory or a register.
    #[track_caller]
    pub fn read_word(&self, address: u64) -> u32 {
        let answer = self.probe(&format!("readl {address:#x}"));
        let number = answer.trim_start_matches("0x");
        let number = u64::from_str_radix(number, 16).expect("a number in hexadecimal");
        u32::try_from(number).expect("32 bits")
    }

    /// Presses a button, or releases it.
    #[track_caller]
    pub fn write(&self, pin: Pin, value: u32) {
        self.probe(&format!("writel {:#x} {value:#x}", self.address(pin)));
    }

    fn address(&self, pin: Pin) -> u64 {
        self.panel.expect("its pins") + 4 * pin as u64
    }

    /// The most bytes of stack that were in use since the board was started.
    #[track_caller]
    pub fn stack_used(&self) -> u64 {
        let Range { start, end } = self.stack;
        let memory = self.probe(&format!("read {start:#x} {:#x}", end - start));
        let memory = memory.trim_start_matches("0x").as_bytes();
        let paint = format!("{PAINT:02x}");
        let untouched = memory
            .chunks(2)
            .take_while(|byte| *byte == paint.as_bytes());
        end - start - untouched.count() as u64
    }

    /// Presses the board's reset button.
    #[track_caller]
    pub fn reset(&self) {
        let mut monitor =
            UnixStream::connect(self.scratch.path("monitor")).expect("QEMU's monitor");
        monitor.set_read_timeout(Some(PATIENCE)).expect("a socket");
        let prompt = |monitor: &mut UnixStream| {
            let mut seen = Vec::new();
            while !seen.ends_with(b"(qemu) ") {
                let mut byte = [0];
                monitor.read_exact(&mut byte).expect("QEMU's prompt");
                seen.extend(byte);
            }
        };
        prompt(&mut monitor);
        monitor.write_all(b"system_reset\n").expect("a command");
        prompt(&mut monitor);
    }

    /// Asks QEMU and gives its answer.
    #[track_caller]
    fn probe(&self, question: &str) -> String {
        let mut probe = self.probe.borrow_mut();
        let asked = writeln!(probe.get_mut(), "{question}");
        asked.expect("QEMU's probe");
        let mut answer = String::new();
        probe.read_line(&mut answer).expect("an answer");
        let answer = answer.trim_end().strip_prefix("OK");
        let answer = answer.unwrap_or_else(|| panic!("QEMU does not know: {question}"));
        answer.trim_start().to_owned()
    }
}

/// Starts QEMU, with the board's serial port and the port that it serves at ports of this machine.
#[track_caller]
fn power_on(
    qemu: &Command,
    probe: &Path,
    served: Option<u16>,
) -> (Process, BufReader<UnixStream>, [u16; 2]) {
    loop {
        let ports @ [port, network] = [reserve_port(), reserve_port()];
        let mut qemu_there = Command::new(qemu.get_program());
        qemu_there.args(qemu.get_args()).arg("-serial");
        qemu_there.arg(format!(
            "tcp:127.0.0.1:{port},server=on,wait=off,nodelay=on"
        ));
        if let Some(served) = served {
            let forward = format!("hostfwd=tcp:127.0.0.1:{network}-:{served}");
            qemu_there.args(["-nic", &format!("user,restrict=on,{forward}")]);
        }
        let process = Process::start(&mut qemu_there);
        let probe = until("QEMU's probe", PATIENCE, || {
            let said = process.stderr();
            let taken = said.contains("in use") || said.contains("set up host forwarding");
            if taken {
                Some(None)
            } else {
                connect_probe(probe).map(Some)
            }
        });
        let Some(probe) = probe else {
            continue;
        };
        if served.is_some() {
            // A SYN that comes before the board's network does is sent again only seconds later.
            until("the board's network", PATIENCE, || receive_byte(network));
        }
        return (process, probe, ports);
    }
}

/// Connects to QEMU's probe. It answers once the machine has all its ports.
fn connect_probe(probe: &Path) -> Option<BufReader<UnixStream>> {
    let mut probe = UnixStream::connect(probe).ok()?;
    probe.set_read_timeout(Some(PATIENCE)).ok()?;
    probe.write_all(b"endianness\n").ok()?;
    let mut probe = BufReader::new(probe);
    let mut answer = String::new();
    probe.read_line(&mut answer).ok()?;
    answer.starts_with("OK").then_some(probe)
}

/// Receives a byte that the board sends to each client. The timeout is short, because the next try may succeed sooner.
fn receive_byte(network: u16) -> Option<()> {
    let mut stream = TcpStream::connect(("127.0.0.1", network)).ok()?;
    stream.set_read_timeout(Some(PATIENCE / 40)).ok()?;
    stream.read_exact(&mut [0]).ok()
}

/// Where a symbol of an image is.
pub(super) fn find(image: &[u8], name: &str) -> Option<u64> {
    let elf = object::File::parse(image).expect("an ELF file");
    let symbol = elf.symbols().find(|symbol| symbol.name() == Ok(name));
    symbol.map(|symbol| symbol.address())
}
