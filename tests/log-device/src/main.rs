//! A device that logs by defmt: `ztl-mcu`'s node at a TCP port, and its log on the same line. Each task
//! logs messages on request.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpListener;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant as Clock};

use ztl_mcu::link::Offer;
use ztl_mcu::log::LogSource;
use ztl_mcu::{Component, Identity, Instant, Node, Refused, Report, Run};

/// Room for the log, as small as in firmware.
const ROOM: usize = 1024;

/// The bytes waiting to be sent, and how many were dropped.
static LOG: Mutex<(VecDeque<u8>, u32)> = Mutex::new((VecDeque::new(), 0));
static ENCODER: Mutex<defmt::Encoder> = Mutex::new(defmt::Encoder::new());

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn keep(bytes: &[u8]) {
    let (log, lost) = &mut *lock(&LOG);
    for &byte in bytes {
        if log.len() < ROOM {
            log.push_back(byte);
        } else {
            *lost = lost.wrapping_add(1);
        }
    }
}

#[defmt::global_logger]
struct Logger;

// SAFETY: only one thread logs, and there are no interrupts.
unsafe impl defmt::Logger for Logger {
    fn acquire() {
        lock(&ENCODER).start_frame(keep);
    }

    unsafe fn flush() {}

    unsafe fn release() {
        lock(&ENCODER).end_frame(keep);
    }

    unsafe fn write(bytes: &[u8]) {
        lock(&ENCODER).write(bytes, keep);
    }
}

defmt::timestamp!("{=u64:ms}", 1500);

struct Source;

impl LogSource for Source {
    fn read(&self, buffer: &mut [u8]) -> usize {
        let (log, _) = &mut *lock(&LOG);
        let count = buffer.len().min(log.len());
        for (to, from) in buffer.iter_mut().zip(log.drain(..count)) {
            *to = from;
        }
        count
    }

    fn lost(&self) -> u32 {
        lock(&LOG).1
    }
}

#[derive(defmt::Format)]
enum Way {
    Up {
        steps: u16,
    },
    #[expect(dead_code, reason = "only so that there is something to tell it from")]
    Down,
}

#[derive(defmt::Format)]
struct Sample {
    way: Way,
    raw: [u8; 3],
    scale: f32,
    name: &'static str,
    next: Option<i8>,
}

defmt::bitflags! {
    struct Flags: u8 {
        const HOT = 1;
        const FAST = 2;
        const LOCKED = 4;
    }
}

/// Logs.
struct Motor;

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new("motor").with_words("all flood")
    }

    fn check(&self, _goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _now: Instant, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        match goal {
            "flood" => {
                for number in 0..200u32 {
                    defmt::info!("number {=u32}", number);
                }
            }
            "all" => log_all(),
            goal => defmt::info!("goes to {=str}", goal),
        }
        Ok(())
    }

    fn poll(&mut self, _now: Instant, _report: &mut Report<'_>) -> Run {
        Run::Completed
    }

    fn abort(&mut self, _now: Instant) {}

    fn make_safe(&mut self, _now: Instant) {}
}

/// Every kind of value.
fn log_all() {
    let sample = Sample {
        way: Way::Up { steps: 300 },
        raw: [1, 2, 255],
        scale: 0.5,
        name: "left",
        next: Some(-3),
    };
    defmt::error!("{}", sample);
    defmt::warn!(
        "{=u8:#x} {=u16:04} {=i8:x} {=bool} {=char}",
        171,
        42,
        -2,
        true,
        'ä'
    );
    defmt::debug!(
        "{=0..4} {0=4..8:b} {=istr}",
        0b1010_0101u8,
        defmt::intern!("interned")
    );
    defmt::info!(
        "{=[u8]:a} {=[u8]:02x} {:?}",
        &b"a\n\""[..],
        &[7, 8][..],
        [Some(1u8), None]
    );
    defmt::info!(
        "{} {=u64:tus} {=u32:iso8601s}",
        Flags::HOT | Flags::LOCKED,
        90_061_000_002,
        951_782_400
    );
    defmt::println!("{} {{}}", defmt::Display2Format(&1.25));
}

fn main() -> std::io::Result<()> {
    let address = std::env::args().nth(1);
    let listener = TcpListener::bind(address.as_deref().unwrap_or("127.0.0.1:0"))?;
    println!("logging at tcp:{}", listener.local_addr()?);
    defmt::info!("started");
    let identity = Identity::new("log-device", "1.0.0", std::process::id());
    let mut node = Node::<_, 2, 256>::new(identity, [Motor]);
    let start = Clock::now();
    loop {
        let (mut stream, _) = listener.accept()?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(Duration::from_millis(5)))?;
        let mut buffer = [0; 64];
        loop {
            let micros = u64::try_from(start.elapsed().as_micros()).unwrap_or(u64::MAX);
            let now = Instant::from_micros(micros);
            match stream.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => node.handle_bytes(now, &buffer[..count]),
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {}
                Err(_) => break,
            }
            node.handle_timeout(now);
            loop {
                let pending = node.transmit_buf(now, &Source);
                let count = pending.len();
                if count == 0 || stream.write_all(pending).is_err() {
                    break;
                }
                node.consume(count);
            }
        }
    }
}
