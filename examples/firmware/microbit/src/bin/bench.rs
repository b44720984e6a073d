//! Measures times on a Cortex-M0. `cargo xtask bench` runs it in QEMU, counts the cycles between the marks, and prints them
//! with the descriptions that this program prints.
#![no_std]
#![no_main]

use core::cell::RefCell;
use core::hint::black_box;
use core::panic::PanicInfo;

use board_support::panel::Lamp;
use cortex_m::asm;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use cortex_m_semihosting::debug::{self, EXIT_SUCCESS};
use critical_section::Mutex;
use embedded_io::Write;
use microbit::uart::Uart;
use salty::{EdwardsPoint, FieldElement, FieldImplementation, Sha512};
use ztl_core::link::{
    ADDR_ONLY_NODE, Body, Frame, Hello, LinkId, NO_SEQ, NO_SESSION, VERSION, encode, session_key,
};
use ztl_core::sink::{SliceSink, put_decimal};
use ztl_mcu::components::{
    DigitalOutput, DigitalOutputConfig, NoPin, StepMotor, Stepper, StepperConfig,
};
use ztl_mcu::log::LogSource;
use ztl_mcu::pump::Pump;
use ztl_mcu::shared::LogQueue;
use ztl_mcu::{Component, Identity, Instant, Node, Reason, Report};

const BOOT: u32 = 77;
const SESSION: u32 = 5;
const NOW: Instant = Instant::from_millis(1000);

/// Fits into the queue.
const BYTES: usize = 120;

static LOG: LogQueue<256> = LogQueue::new();

const SLIDE: StepperConfig = StepperConfig {
    range: (0, 4000),
    speed: 10_000,
    ..StepperConfig::DEFAULT
};

/// Soon at full speed.
const FAST: StepperConfig = StepperConfig {
    acceleration: 200_000,
    ..SLIDE
};

type Motor = Mutex<RefCell<StepMotor<NoPin, NoPin>>>;

static MOTOR: Motor = Mutex::new(RefCell::new(StepMotor::new(NoPin, NoPin, &SLIDE)));
static FAST_MOTOR: Motor = Mutex::new(RefCell::new(StepMotor::new(NoPin, NoPin, &FAST)));

type LampNode = Node<'static, [DigitalOutput<Lamp>; 1], 4, 256>;

#[entry]
fn main() -> ! {
    let mut uart = Uart::start();
    // The interrupt is counted when it comes.
    while app::RECEIVED.is_empty() {
        asm::wfi();
    }
    app::RECEIVED.take(&mut [0]);
    say(&mut uart, 1, "a byte received: the interrupt");

    let lamp = DigitalOutput::new("lamp", Lamp, DigitalOutputConfig::DEFAULT);
    let mut node = LampNode::new(Identity::new("desk", "1", BOOT), [lamp]);
    let hello = Body::Hello(Hello {
        version: VERSION,
        session: SESSION,
        gateway: 1,
    });
    framed(NO_SESSION, NO_SEQ, hello, |bytes| {
        node.handle_bytes(NOW, bytes)
    });
    send(&mut node, NOW);
    let key = session_key(SESSION, BOOT);
    // Nothing: what a mark takes.
    counted(|| ());

    for byte in 1..=BYTES as u8 {
        app::RECEIVED.push(byte);
    }
    let mut buffer = [0; 32];
    counted(|| while app::RECEIVED.take(&mut buffer) > 0 {});
    say(&mut uart, BYTES, "a byte out of the queue");

    // A frame as long as any, which the node does not obey: only its way in counts.
    let goal = core::str::from_utf8(&[b'x'; 200]).unwrap_or_default();
    let start = |goal: &'static str| Body::Start {
        task: LinkId(1),
        component: 0,
        goal,
        before_ms: u64::MAX,
    };
    let len = feed(&mut node, key, 99, start(goal));
    say(
        &mut uart,
        len,
        "a byte of a long frame into the node, with all checks of the frame",
    );

    feed_and_send(&mut node, key, 1, start("pulse 500"));
    say(&mut uart, 1, "a task's start: its frame, goal and answer");
    feed_and_send(&mut node, key, 2, Body::Ping);
    say(&mut uart, 1, "a ping and its answer");
    // What a main loop shares with interrupts besides: no other critical section may be longer.
    LOG.push(&[7; 200]);
    let mut frame = [0; 200];
    counted(|| {
        let _ = black_box(LOG.read(&mut frame));
    });
    say(&mut uart, frame.len(), "a byte of the log into its frame");
    drive(&mut uart);

    verify(&mut uart);

    // Its progress, so that nothing is left to be said.
    node.handle_timeout(NOW);
    send(&mut node, NOW.after(40_000));
    let pump = Pump::new();
    // The lamp is polled then, and its progress is not told yet.
    let later = NOW.after(50_000);
    counted(|| {
        let _ = black_box(pump.turn_split(&mut node, &mut &app::RECEIVED, &mut uart, later));
    });
    say(
        &mut uart,
        1,
        "a turn of the main loop in which nothing comes, with a task",
    );
    debug::exit(EXIT_SUCCESS);
    SCB::sys_reset()
}

/// Measures the start of a motion, and lets an interrupt drive two motors: at first in time, then ever later. No critical
/// section may be too long.
#[inline(never)]
fn drive(uart: &mut Uart) {
    let mut slide = Stepper::new("slide", &MOTOR, SLIDE);
    let mut text = Reason::new();
    let mut why = Report::new(&mut text);
    counted(|| {
        let _ = black_box(slide.start(NOW, "2000", &mut why));
    });
    say(uart, 1, "a motion of a motor that an interrupt drives");
    let mut fast = Stepper::new("fast", &FAST_MOTOR, FAST);
    let _ = black_box(fast.start(NOW, "4000", &mut why));
    for motor in [&MOTOR, &FAST_MOTOR] {
        let mut now = NOW;
        for _ in 0..800 {
            tick(motor, now);
            now = now.after(50);
        }
        for late_ms in 0..50 {
            now = now.after(late_ms * 1000);
            for _ in 0..5 + late_ms % 4 {
                tick(motor, now);
                now = now.after(25);
            }
        }
    }
    for motor in [&mut slide, &mut fast] {
        let _ = black_box(motor.poll(NOW, &mut why));
        motor.abort(NOW);
        motor.make_safe(NOW);
    }
}

/// The timer's interrupt of a motor.
fn tick(motor: &Motor, now: Instant) {
    critical_section::with(|token| motor.borrow(token).borrow_mut().tick(now));
}

/// Measures what the verification of an image consists of.
// Apart, so that its points do not stay on the stack.
#[inline(never)]
fn verify(uart: &mut Uart) {
    let mut hash = Sha512::new();
    counted(|| hash.update(black_box(&[7; 128])));
    say(uart, 1, "an update: 128 bytes into the hash of the image");
    let factor = FieldElement::D;
    counted(|| {
        let _ = black_box(black_box(&factor) * black_box(&factor));
    });
    say(uart, 1, "an update: a multiplication of its signature");
    let point = EdwardsPoint::basepoint();
    counted(|| {
        let _ = black_box(black_box(&point) + black_box(&point));
    });
    say(uart, 1, "an update: an addition of points of its signature");
}

/// Encodes a frame and measures how the node handles it. Returns its length.
fn feed(node: &mut LampNode, session: u32, seq: u8, body: Body<'_>) -> usize {
    framed(session, seq, body, |bytes| {
        counted(|| node.handle_bytes(NOW, bytes));
    })
}

/// The same, with what the node says to it.
fn feed_and_send(node: &mut LampNode, session: u32, seq: u8, body: Body<'_>) {
    framed(session, seq, body, |bytes| {
        counted(|| {
            node.handle_bytes(NOW, bytes);
            send(node, NOW);
        });
    });
}

fn framed(session: u32, seq: u8, body: Body<'_>, act: impl FnOnce(&[u8])) -> usize {
    let mut bytes = [0; 256];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body,
    };
    let len = encode(session, &frame, &mut bytes).unwrap_or_default();
    act(bytes.get(..len).unwrap_or_default());
    len
}

/// Encodes and takes the output of the node.
fn send(node: &mut LampNode, now: Instant) {
    loop {
        let count = black_box(node.transmit_buf(now, &())).len();
        if count == 0 {
            break;
        }
        node.consume(count);
    }
}

/// Measures the code between two marks.
fn counted(act: impl FnOnce()) {
    count_begin();
    act();
    count_end();
}

#[unsafe(no_mangle)]
#[inline(never)]
extern "C" fn count_begin() {
    asm::nop();
}

#[unsafe(no_mangle)]
#[inline(never)]
extern "C" fn count_end() {
    // Two, so that it is another function than the first.
    asm::nop();
    asm::nop();
}

/// A line of the output: the number of runs and the description.
fn say(uart: &mut Uart, times: usize, what: &str) {
    let mut line = [0; 80];
    let mut sink = SliceSink::new(&mut line);
    put_decimal(&mut sink, times as u32);
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
