//! What an async driver, interrupts and the main loop share, at the greatest lengths that a frame allows. `cargo xtask bench`
//! runs it in QEMU like `bench.rs`, and fails if one of its critical sections is too long.
#![no_std]
#![no_main]

use core::future::{Future, pending};
use core::hint::black_box;
use core::panic::PanicInfo;
use core::pin::pin;
use core::task::{Context, Waker};

use board_support::panel::Lamp;
use cortex_m::asm;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use cortex_m_semihosting::debug::{self, EXIT_SUCCESS};
use embedded_io::Write;
use microbit::uart::Uart;
use ztl_core::link::{LONGEST_FRAME, Offer};
use ztl_mcu::components::DigitalOutput;
use ztl_mcu::driver::{Driver, Failed, Progress, Slot};
use ztl_mcu::shared::LatestReading;
use ztl_mcu::{Component, Instant, Node, Reason, Refused, Report};

const READING: usize = Node::<[DigitalOutput<Lamp>; 1], 1, LONGEST_FRAME>::LONGEST_READING;
/// Longer than any goal.
const GOAL: usize = LONGEST_FRAME;
/// Longest text of a task.
const TEXT: usize = 48;

static LATEST: LatestReading<READING> = LatestReading::new();

/// Takes any goal, and tells as much as it may.
struct Endless;

impl Driver for Endless {
    fn check(_: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
        progress.write(|report| report.text(goal.get(..TEXT).unwrap_or_default()));
        pending().await
    }

    async fn make_safe(&mut self) {}
}

#[entry]
fn main() -> ! {
    let mut uart = Uart::start();
    // The interrupt is counted when it comes.
    while app::RECEIVED.is_empty() {
        asm::wfi();
    }
    say(&mut uart, "a byte received: the interrupt");
    counted(|| ());

    let mut bytes = [b'x'; GOAL];
    counted(|| {
        let reading = black_box(&bytes).get(..READING).unwrap_or_default();
        let _ = black_box(LATEST.set(reading));
    });
    say(&mut uart, "the longest reading, set");
    counted(|| {
        let _ = black_box(LATEST.take(0, black_box(&mut bytes)));
    });
    say(&mut uart, "the longest reading, taken");

    let slot = Slot::<Endless, GOAL>::new(Offer::new("endless"));
    let mut driver = Endless;
    let mut running = pin!(slot.run(&mut driver, || Instant::ZERO));
    let mut context = Context::from_waker(Waker::noop());
    let mut component = slot.component();
    let mut text = Reason::new();
    let mut report = Report::new(&mut text);
    let _ = running.as_mut().poll(&mut context);
    let goal = core::str::from_utf8(black_box(&bytes)).unwrap_or_default();
    counted(|| {
        let _ = black_box(component.start(Instant::ZERO, goal, &mut report));
    });
    say(
        &mut uart,
        "a task of a driver with the longest goal, started",
    );
    counted(|| {
        let _ = black_box(running.as_mut().poll(&mut context));
    });
    say(&mut uart, "the task begins, and writes its progress");
    counted(|| {
        let _ = black_box(component.poll(Instant::ZERO, &mut report));
    });
    say(&mut uart, "the progress, read");
    component.abort(Instant::ZERO);
    component.make_safe(Instant::ZERO);
    debug::exit(EXIT_SUCCESS);
    SCB::sys_reset()
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

/// A line of the output: one run, and what it was.
fn say(uart: &mut Uart, what: &str) {
    for part in ["1 ", what, "\n"] {
        let mut rest = part.as_bytes();
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
