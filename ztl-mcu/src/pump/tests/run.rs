//! The main loop as a future, on an executor of a few lines whose time is virtual.

use super::*;
use core::cell::RefCell;
use core::convert::Infallible;
use core::future::{Future, poll_fn};
use core::pin::{Pin, pin};
use core::task::{Context, Poll, Waker};
use embedded_hal_async::delay::DelayNs;
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::Wake;

/// The state shared by the test and the ports.
#[derive(Default)]
struct World {
    micros: Cell<u64>,
    /// When the first delay that is waited for is over.
    alarm: Cell<Option<u64>>,
    rx: RefCell<VecDeque<u8>>,
    tx: RefCell<Vec<u8>>,
    /// The port takes no bytes.
    stuck: Cell<bool>,
    /// The port takes no bytes, and says so at once.
    full: Cell<bool>,
    /// Writes that were tried.
    writes: Cell<u32>,
    closed: Cell<bool>,
}

struct Rx(Rc<World>);

impl ErrorType for Rx {
    type Error = Infallible;
}

impl embedded_io_async::Read for Rx {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|_| {
            let mut rx = self.0.rx.borrow_mut();
            let count = rx.len().min(buffer.len()).min(5);
            if count == 0 && !self.0.closed.get() {
                return Poll::Pending;
            }
            for (to, from) in buffer.iter_mut().zip(rx.drain(..count)) {
                *to = from;
            }
            Poll::Ready(Ok(count))
        })
        .await
    }
}

struct Tx(Rc<World>);

impl ErrorType for Tx {
    type Error = Infallible;
}

impl embedded_io_async::Write for Tx {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        poll_fn(|_| {
            self.0.writes.set(self.0.writes.get() + 1);
            if self.0.stuck.get() {
                return Poll::Pending;
            }
            if self.0.full.get() {
                return Poll::Ready(Ok(0));
            }
            let count = bytes.len().min(7);
            self.0.tx.borrow_mut().extend_from_slice(&bytes[..count]);
            Poll::Ready(Ok(count))
        })
        .await
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

struct Delay(Rc<World>);

impl DelayNs for Delay {
    async fn delay_ns(&mut self, nanos: u32) {
        let end = self.0.micros.get() + u64::from(nanos).div_ceil(1000);
        poll_fn(|_| {
            if self.0.micros.get() >= end {
                return Poll::Ready(());
            }
            let other = self.0.alarm.get().unwrap_or(end);
            self.0.alarm.set(Some(end.min(other)));
            Poll::Pending
        })
        .await;
    }
}

#[derive(Default)]
struct Woken(AtomicBool);

impl Wake for Woken {
    fn wake(self: Arc<Self>) {
        self.0.store(true, Ordering::Release);
    }
}

type Looped<'f> = Pin<&'f mut dyn Future<Output = PumpError<Infallible, Infallible>>>;

/// Polls as long as there is something to do, then lets time pass up to the alarm; until `millis`.
fn run_until(
    world: &World,
    future: &mut Looped<'_>,
    millis: u64,
) -> Option<PumpError<Infallible, Infallible>> {
    let woken = Arc::new(Woken::default());
    let waker = Waker::from(Arc::clone(&woken));
    let mut context = Context::from_waker(&waker);
    for _ in 0..1_000_000 {
        woken.0.store(false, Ordering::Release);
        world.alarm.set(None);
        if let Poll::Ready(error) = future.as_mut().poll(&mut context) {
            return Some(error);
        }
        if woken.0.load(Ordering::Acquire) {
            continue;
        }
        let end = millis * 1000;
        match world.alarm.get() {
            Some(alarm) if alarm <= end => world.micros.set(alarm.max(world.micros.get())),
            _ => {
                world.micros.set(end);
                return None;
            }
        }
    }
    panic!("it never rests");
}

async fn looped(
    pump: &Pump<'_>,
    node: &mut BeltNode,
    world: &Rc<World>,
) -> PumpError<Infallible, Infallible> {
    let (mut rx, mut tx) = (Rx(Rc::clone(world)), Tx(Rc::clone(world)));
    let mut delay = Delay(Rc::clone(world));
    let clock = || Instant::from_micros(world.micros.get());
    let Err(error) = pump.run(node, &mut rx, &mut tx, &mut delay, clock).await;
    error
}

/// Greets, and starts a task.
fn begin(world: &World, future: &mut Looped<'_>) {
    let now = world.micros.get().div_ceil(1000);
    for bytes in [hello(), start()] {
        world.rx.borrow_mut().extend(bytes);
        run_until(world, future, now);
    }
    let said = taken(world);
    assert!(
        said.ends_with(&["Welcome".into(), "Started 9".into()]),
        "{said:?}"
    );
}

fn taken(world: &World) -> Vec<String> {
    said(&core::mem::take(&mut *world.tx.borrow_mut()))
}

#[test]
fn the_loop_sends_awake_answers_and_acts_on_a_lost_link() {
    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    let mut future = pin!(looped(&pump, &mut node, &world));
    let mut future: Looped<'_> = future.as_mut();
    run_until(&world, &mut future, 300);
    assert_eq!(taken(&world), ["Awake", "Awake"]);
    begin(&world, &mut future);
    run_until(&world, &mut future, 1290);
    assert_eq!(taken(&world), [""; 0]);
    run_until(&world, &mut future, 1450);
    assert_eq!(
        taken(&world),
        ["Ended link was lost", "Ended link was lost"]
    );
}

#[test]
fn a_blocked_port_delays_nothing() {
    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    {
        let mut future = pin!(looped(&pump, &mut node, &world));
        let mut future: Looped<'_> = future.as_mut();
        begin(&world, &mut future);
        world.stuck.set(true);
        world.rx.borrow_mut().extend(frame(KEY, 2, Body::Ping));
        run_until(&world, &mut future, 900);
        assert_eq!(taken(&world), [""; 0]);
    }
    let polls = belt(&node).polls.get();
    assert!((80..=100).contains(&polls), "{polls}");
    // Started again, the loop continues without losing unsent bytes.
    {
        let mut future = pin!(looped(&pump, &mut node, &world));
        let mut future: Looped<'_> = future.as_mut();
        world.stuck.set(false);
        run_until(&world, &mut future, 901);
        assert!(matches!(&taken(&world)[..], [pong] if pong.starts_with("Pong")));
        world.stuck.set(true);
        run_until(&world, &mut future, 2000);
    }
    assert!(!belt(&node).moves.get(), "the link was lost");
}

#[test]
fn a_full_port_is_offered_bytes_now_and_then() {
    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    let mut future = pin!(looped(&pump, &mut node, &world));
    let mut future: Looped<'_> = future.as_mut();
    begin(&world, &mut future);
    world.full.set(true);
    world.rx.borrow_mut().extend(frame(KEY, 2, Body::Ping));
    let before = world.writes.get();
    run_until(&world, &mut future, 100);
    let tried = world.writes.get() - before;
    assert!((20..=300).contains(&tried), "{tried}");
    world.full.set(false);
    run_until(&world, &mut future, 103);
    assert!(matches!(&taken(&world)[..], [pong, ..] if pong.starts_with("Pong")));
}

/// A port that is there or not, as one on USB.
struct Usb(Rc<World>);

impl ErrorType for Usb {
    type Error = ErrorKind;
}

impl embedded_io_async::Read for Usb {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, ErrorKind> {
        if self.0.closed.get() {
            return Err(ErrorKind::NotConnected);
        }
        poll_fn(
            |_| match self.0.closed.get() || !self.0.rx.borrow().is_empty() {
                true => Poll::Ready(()),
                false => Poll::Pending,
            },
        )
        .await;
        let Ok(count) = Rx(Rc::clone(&self.0)).read(buffer).await;
        match count {
            0 => Err(ErrorKind::NotConnected),
            count => Ok(count),
        }
    }
}

impl embedded_io_async::Write for Usb {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        if self.0.closed.get() {
            return Err(ErrorKind::NotConnected);
        }
        assert!(bytes.len() < 64, "the host waits for more");
        self.0.tx.borrow_mut().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    async fn flush(&mut self) -> Result<(), ErrorKind> {
        Err(ErrorKind::NotConnected)
    }
}

#[test]
fn an_unplugged_port_ends_nothing_and_serves_again() {
    use crate::pump::Plugged;

    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    let serve = async {
        let halves = [Usb(Rc::clone(&world)), Usb(Rc::clone(&world))];
        let [mut rx, mut tx] = halves.map(|half| Plugged::new(half, Delay(Rc::clone(&world))));
        let mut delay = Delay(Rc::clone(&world));
        let clock = || Instant::from_micros(world.micros.get());
        let Err(error) = pump
            .run(&mut node, &mut rx, &mut tx, &mut delay, clock)
            .await;
        error
    };
    {
        let mut future = pin!(serve);
        let mut future: Looped<'_> = future.as_mut();
        run_until(&world, &mut future, 10);
        begin(&world, &mut future);
        world.closed.set(true);
        assert_eq!(run_until(&world, &mut future, 1500), None);
        world.closed.set(false);
        assert_eq!(run_until(&world, &mut future, 1700), None);
        assert!(taken(&world).contains(&"Ended link was lost".into()));
        world.rx.borrow_mut().extend(hello());
        run_until(&world, &mut future, 1800);
        assert!(taken(&world).contains(&"Ended link was lost".into()));
    }
    assert!(!belt(&node).moves.get());
}

#[test]
fn endless_readings_do_not_starve_other_work() {
    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    node.components_mut()[0].endless = true;
    let mut future = pin!(looped(&pump, &mut node, &world));
    let mut future: Looped<'_> = future.as_mut();
    let woken = Arc::new(Woken::default());
    let waker = Waker::from(Arc::clone(&woken));
    let mut context = Context::from_waker(&waker);
    let mut poll = |times| {
        for _ in 0..times {
            assert!(future.as_mut().poll(&mut context).is_pending());
        }
        taken(&world)
    };
    for (bytes, answer) in [(hello(), "Welcome"), (start(), "Started 9")] {
        world.rx.borrow_mut().extend(bytes);
        assert_eq!(
            poll(30).iter().find(|line| *line != "Awake").unwrap(),
            answer
        );
    }
    let said = poll(300);
    assert!(said.len() > 10 && said.iter().all(|line| line == "Publish"));
    world.rx.borrow_mut().extend(frame(KEY, 2, Body::Ping));
    assert!(poll(30).iter().any(|line| line.starts_with("Pong")));
}

#[test]
fn a_closed_port_is_reported_after_polling_the_components() {
    let (world, pump, mut node) = (Rc::new(World::default()), Pump::new(), node());
    {
        let mut future = pin!(looped(&pump, &mut node, &world));
        let mut future: Looped<'_> = future.as_mut();
        begin(&world, &mut future);
    }
    world.closed.set(true);
    let before = belt(&node).polls.get();
    for _ in 0..3 {
        // It asked to be polled then.
        world.micros.set(world.micros.get() + 10_000);
        let mut future = pin!(looped(&pump, &mut node, &world));
        let mut future: Looped<'_> = future.as_mut();
        assert_eq!(run_until(&world, &mut future, 40), Some(PumpError::Closed));
    }
    assert_eq!(belt(&node).polls.get(), before + 3);
}

#[test]
fn the_log_is_sent_while_the_node_idles() {
    let page = Page(Cell::new(20));
    let (world, mut node) = (Rc::new(World::default()), node());
    let pump = Pump::new().with_log(&page);
    let mut future = pin!(looped(&pump, &mut node, &world));
    let mut future: Looped<'_> = future.as_mut();
    for bytes in [hello(), start()] {
        world.rx.borrow_mut().extend(bytes);
        run_until(&world, &mut future, 5);
    }
    assert_eq!(taken(&world).last().unwrap(), "Log 3 20");
    page.0.set(10);
    run_until(&world, &mut future, 16);
    assert_eq!(taken(&world), ["Log 3 10"]);
}

#[cfg(feature = "critical-section")]
#[test]
fn an_interrupts_stop_wakes_the_loop_at_once() {
    use crate::shared::StopFlag;

    static STOP: StopFlag = StopFlag::new();
    let (world, mut node) = (Rc::new(World::default()), node());
    let pump = Pump::new().with_stop(&STOP);
    let woken = Arc::new(Woken::default());
    let waker = Waker::from(Arc::clone(&woken));
    {
        let mut future = pin!(looped(&pump, &mut node, &world));
        let mut future: Looped<'_> = future.as_mut();
        begin(&world, &mut future);
        assert!(
            future
                .as_mut()
                .poll(&mut Context::from_waker(&waker))
                .is_pending()
        );
        std::thread::spawn(|| STOP.raise()).join().unwrap();
        assert!(woken.0.load(Ordering::Acquire));
        // No time passes.
        run_until(&world, &mut future, 5);
        assert_eq!(taken(&world), ["Ended emergency stop"]);
    }
    assert!(node.is_stopped());
}
