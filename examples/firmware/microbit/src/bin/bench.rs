//! Counts instructions: `cargo xtask bench` runs it in QEMU, where each takes 64 ns, and prints what it says.
#![no_std]
#![no_main]

use core::hint::black_box;
use core::panic::PanicInfo;

use cortex_m::Peripherals;
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};
use cortex_m_rt::entry;
use cortex_m_semihosting::debug::{self, EXIT_SUCCESS};
use embedded_io::Write;
use microbit::uart::Uart;
use qemu::panel::Lamp;
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, VERSION, encode, session_key,
};
use ztl_core::sink::{SliceSink, put_decimal};
use ztl_mcu::components::{DigitalOutput, DigitalOutputConfig};
use ztl_mcu::{Identity, Instant, Node};

const BOOT: u32 = 77;
const SESSION: u32 = 5;
const NOW: Instant = Instant::from_millis(1000);

type Desk = Node<'static, [DigitalOutput<Lamp>; 1], 4, 256>;

#[entry]
fn main() -> ! {
    let Some(mut core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    core.SYST.set_clock_source(SystClkSource::Core);
    core.SYST.set_reload(0x00FF_FFFF);
    core.SYST.clear_current();
    core.SYST.enable_counter();
    let mut uart = Uart::start();

    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let mut node = Desk::new(Identity::new("desk", "1", BOOT), [lamp]);
    let hello = Body::Hello(Hello {
        version: VERSION,
        session: SESSION,
        gateway: 1,
    });
    feed(&mut node, NO_SESSION, NO_SEQ, hello);
    send(&mut node);
    let key = session_key(SESSION, BOOT);

    // A frame as long as any, which the node does not obey: only its way in counts.
    let goal = core::str::from_utf8(&[b'x'; 200]).unwrap_or_default();
    let long = Body::Start {
        task: LinkId(1),
        component: 9,
        goal,
        before_ms: u64::MAX,
    };
    let mut bytes = [0; 256];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq: 99,
        body: long,
    };
    let len = encode(key, &frame, &mut bytes).unwrap_or_default();
    let bytes = bytes.get(..len).unwrap_or_default();
    let count = len as u32;
    let queue = black_box(&app::RECEIVED);
    let push = instructions(|| {
        for &byte in bytes.iter().take(120) {
            queue.push(byte);
        }
    });
    let mut buffer = [0; 32];
    let take = instructions(|| while queue.take(&mut buffer) > 0 {});
    let handle = instructions(|| node.handle_bytes(NOW, bytes));
    say(
        &mut uart,
        "a byte into the queue, by the interrupt",
        push / 120,
    );
    say(&mut uart, "a byte out of the queue", take / 120);
    say(
        &mut uart,
        "a byte into the node, its part of the check included",
        handle / count,
    );

    let start = Body::Start {
        task: LinkId(1),
        component: 0,
        goal: "pulse 500",
        before_ms: u64::MAX,
    };
    let taken = feed(&mut node, key, 1, start);
    let answered = instructions(|| send(&mut node));
    let ping = feed(&mut node, key, 2, Body::Ping);
    let ponged = instructions(|| send(&mut node));
    say(
        &mut uart,
        "a task's start: its frame, goal and answer",
        taken + answered,
    );
    say(&mut uart, "a ping and its answer", ping + ponged);
    let idle = instructions(|| {
        node.handle_timeout(NOW);
        black_box(node.poll_timeout(NOW));
    });
    say(
        &mut uart,
        "a turn in which nothing happens, with a task",
        idle,
    );
    debug::exit(EXIT_SUCCESS);
    SCB::sys_reset()
}

/// Encodes a frame and gives it to the node: the instructions that the node makes of it.
fn feed(node: &mut Desk, session: u32, seq: u8, body: Body<'_>) -> u32 {
    let mut bytes = [0; 64];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let len = encode(session, &frame, &mut bytes).unwrap_or_default();
    instructions(|| node.handle_bytes(NOW, bytes.get(..len).unwrap_or_default()))
}

/// Makes and takes what the node has to say.
fn send(node: &mut Desk) {
    let mut buffer = [0; 64];
    while node.poll_transmit(NOW, &mut buffer) > 0 {}
    black_box(buffer);
}

/// At 16 MHz a tick is 62.5 ns, an instruction 64.
fn instructions(act: impl FnOnce()) -> u32 {
    let before = SYST::get_current();
    act();
    let after = SYST::get_current();
    (before.wrapping_sub(after) & 0x00FF_FFFF) * 125 / 128
}

/// A line: a number and what it is.
fn say(uart: &mut Uart, what: &str, count: u32) {
    let mut line = [0; 80];
    let mut sink = SliceSink::new(&mut line);
    put_decimal(&mut sink, count);
    for part in [
        sink.finish().unwrap_or_default(),
        b" ",
        what.as_bytes(),
        b"\n",
    ] {
        let mut rest = part;
        while !rest.is_empty() {
            let written = uart.write(rest).unwrap_or_default();
            rest = rest.get(written..).unwrap_or_default();
        }
    }
}

#[cortex_m_rt::exception]
fn SysTick() {}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    SCB::sys_reset()
}
