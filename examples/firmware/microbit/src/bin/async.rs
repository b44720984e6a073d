//! The lamp of `smallest.rs` as an async driver. The main loop polls its future itself, in the place of an executor. Its size
//! is recorded.
#![no_std]
#![no_main]

use core::cell::Cell;
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::{Context, Poll, Waker};
use core::time::Duration;

use board_support::board::Clock;
use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embedded_hal::digital::OutputPin;
use embedded_io::Write;
use microbit::random;
use microbit::uart::Uart;
use ztl_mcu::driver::{Driver, Failed, Progress, Slot, SlotComponent};
use ztl_mcu::link::Offer;
use ztl_mcu::{Identity, Instant, Node, Refused, Report};

/// A lamp that waits for the time of the main loop.
struct AsyncLamp<'c> {
    now: &'c Cell<Instant>,
}

/// What a goal asks for: light, and for how long.
fn parse(goal: &str) -> Option<(bool, Option<u32>)> {
    match goal {
        "on" => Some((true, None)),
        "off" => Some((false, None)),
        _ => Some((true, Some(goal.strip_prefix("pulse ")?.parse().ok()?))),
    }
}

fn shine(light: bool) {
    let Ok(()) = if light {
        Lamp.set_high()
    } else {
        Lamp.set_low()
    };
}

impl Driver for AsyncLamp<'_> {
    fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        if parse(goal).is_none() {
            why.text("lamp takes on, off, or pulse and milliseconds");
            return Err(Refused);
        }
        Ok(())
    }

    async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
        let (light, millis) = parse(goal).ok_or(Failed)?;
        shine(light);
        if let Some(millis) = millis {
            let end = self.now.get() + Duration::from_millis(millis.into());
            poll_fn(|context| {
                if self.now.get() >= end {
                    return Poll::Ready(());
                }
                // Nothing else wakes an executor: the time has no alarm here.
                context.waker().wake_by_ref();
                Poll::Pending
            })
            .await;
            shine(false);
        }
        progress.write(|report| report.text(goal));
        Ok(())
    }

    async fn make_safe(&mut self) {
        shine(false);
    }
}

type LampSlot<'c> = Slot<'static, AsyncLamp<'c>>;

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let slot = LampSlot::new(Offer::new("lamp"));
    let now = Cell::new(Instant::ZERO);
    let mut lamp = AsyncLamp { now: &now };
    let mut driver = pin!(slot.run(&mut lamp, || now.get()));
    let mut node = node(&slot);
    let mut uart = Uart::start();
    let mut clock = SysTick::<16_000>::start(core.SYST);
    let mut received = [0; 32];
    loop {
        now.set(clock.now());
        // It never ends: this is its only future.
        let _ = driver
            .as_mut()
            .poll(&mut Context::from_waker(Waker::noop()));
        let count = app::RECEIVED.take(&mut received);
        node.handle_bytes(now.get(), received.get(..count).unwrap_or_default());
        node.handle_timeout(now.get());
        let Ok(sent) = uart.write(node.transmit_buf(now.get(), &()));
        node.consume(sent);
    }
}

// Apart, so that nothing but the node stays on the stack.
#[inline(never)]
fn node<'s, 'c>(
    slot: &'s LampSlot<'c>,
) -> Node<'static, [SlotComponent<'s, 'static, AsyncLamp<'c>>; 1], 2, 128> {
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), random::word());
    Node::new(identity, [slot.component()])
}

board_support::handlers!();
