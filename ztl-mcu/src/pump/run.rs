//! The main loop as a future.

use core::cell::{Cell, RefCell};
use core::convert::Infallible;
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::{Context, Poll};
use core::time::Duration;

use embedded_hal_async::delay::DelayNs;
use embedded_io_async::{Read, Write};
use ztl_core::Instant;

use super::turn::{LOG_AGAIN, Pump, PumpError};
use crate::{Components, Node};

/// How often a port that takes nothing is offered bytes.
const FULL_AGAIN: Duration = Duration::from_millis(1);

/// State shared by the three loops. No loop borrows the node while it waits.
struct Shared<'p, 'n, C, const TASKS: usize, const FRAME: usize> {
    pump: &'p Pump<'p>,
    node: RefCell<&'p mut Node<'n, C, TASKS, FRAME>>,
    /// Something has changed that may wake the components' loop earlier.
    move_on: Cell<bool>,
    /// There may be something to send.
    send: Cell<bool>,
    /// The port took nothing: when it is offered bytes again.
    full_until: Cell<Instant>,
}

impl Pump<'_> {
    /// Runs a node forever. Reading, advancing the components and sending are concurrent, so that a port that takes no
    /// bytes delays nothing else. `clock` returns the time, `delay` waits.
    ///
    /// With embassy: the halves of a `BufferedUart` or of USB's `CdcAcmClass` in [`Plugged`](super::Plugged),
    /// `embassy_time::Delay`, and `|| Instant::from_micros(embassy_time::Instant::now().as_micros())`.
    ///
    /// The future may be dropped at any time, and called again with the same node and the same or another port. A
    /// partially transferred frame is then lost, as on a bad line, unless `read` and `write` of the port are
    /// cancellation-safe. The components move only while the future runs: after an error call it again at once, if
    /// necessary with a port that is never ready.
    ///
    /// # Errors
    /// Those of the port, and [`PumpError::Closed`] if a read returns no bytes.
    pub async fn run<R, W, D, C, const TASKS: usize, const FRAME: usize>(
        &self,
        node: &mut Node<'_, C, TASKS, FRAME>,
        rx: &mut R,
        tx: &mut W,
        delay: &mut D,
        clock: impl Fn() -> Instant,
    ) -> Result<Infallible, PumpError<R::Error, W::Error>>
    where
        R: Read,
        W: Write,
        D: DelayNs,
        C: Components,
    {
        let shared = Shared {
            pump: self,
            node: RefCell::new(node),
            move_on: Cell::new(false),
            send: Cell::new(true),
            full_until: Cell::new(Instant::NEVER),
        };
        let mut moving = pin!(shared.keep_moving(delay, &clock));
        let mut reading = pin!(shared.keep_reading(rx, &clock));
        let mut sending = pin!(shared.keep_sending(tx, &clock));
        poll_fn(|context| {
            // In this order, so that the components advance at least once before the port fails.
            let Poll::Pending = moving.as_mut().poll(context);
            if let Poll::Ready(error) = reading.as_mut().poll(context) {
                return Poll::Ready(Err(error));
            }
            sending
                .as_mut()
                .poll(context)
                .map(|error| Err(PumpError::Write(error)))
        })
        .await
    }
}

impl<C: Components, const TASKS: usize, const FRAME: usize> Shared<'_, '_, C, TASKS, FRAME> {
    /// Borrows the node, which no other loop does meanwhile.
    fn node<T>(&self, act: impl FnOnce(&mut Node<'_, C, TASKS, FRAME>) -> T) -> Option<T> {
        self.node
            .try_borrow_mut()
            .ok()
            .map(|mut node| act(&mut node))
    }

    async fn keep_moving(
        &self,
        delay: &mut impl DelayNs,
        clock: &impl Fn() -> Instant,
    ) -> Infallible {
        loop {
            let now = clock();
            let pause = self.node(|node| {
                self.pump.take_stop(node, now);
                node.handle_timeout(now);
                // The sending loop handles what is due already.
                let send = Some(node.next_transmit(now)).filter(|at| *at > now);
                let log = self.pump.log.map(|_| now + LOG_AGAIN);
                let moving = node.next_move().min(self.full_until.get());
                let wake = [send, log].into_iter().flatten().fold(moving, Instant::min);
                (wake != Instant::NEVER).then(|| wake.as_micros().saturating_sub(now.as_micros()))
            });
            self.send.set(true);
            let pause = pause.flatten().unwrap_or(1_000_000);
            if pause > 0 {
                let pause = delay.delay_us(u32::try_from(pause).unwrap_or(u32::MAX));
                let mut pause = pin!(pause);
                poll_fn(|context| {
                    if self.move_on.take() || self.poll_stop(context).is_ready() {
                        return Poll::Ready(());
                    }
                    pause.as_mut().poll(context)
                })
                .await;
            }
            yield_now().await;
        }
    }

    fn poll_stop(&self, context: &Context<'_>) -> Poll<()> {
        #[cfg(feature = "critical-section")]
        if let Some(stop) = self.pump.stop {
            return stop.poll_raised(context);
        }
        let _ = context;
        Poll::Pending
    }

    async fn keep_reading<R: Read, W>(
        &self,
        rx: &mut R,
        clock: &impl Fn() -> Instant,
    ) -> PumpError<R::Error, W> {
        let mut buffer = [0; 64];
        loop {
            let count = match rx.read(&mut buffer).await {
                Ok(0) => return PumpError::Closed,
                Ok(count) => count,
                Err(error) => return PumpError::Read(error),
            };
            let bytes = buffer.get(..count).unwrap_or_default();
            self.node(|node| node.handle_bytes(clock(), bytes));
            self.move_on.set(true);
            self.send.set(true);
            yield_now().await;
        }
    }

    async fn keep_sending<W: Write>(&self, tx: &mut W, clock: &impl Fn() -> Instant) -> W::Error {
        // A copy, so that the node is not borrowed while the port writes.
        let mut chunk = [0; 64];
        let mut flushed = true;
        loop {
            let count = self.node(|node| {
                let pending = node.transmit_buf(clock(), self.pump.log());
                for (to, from) in chunk.iter_mut().zip(pending) {
                    *to = *from;
                }
                pending.len().min(chunk.len())
            });
            let bytes = chunk.get(..count.unwrap_or_default()).unwrap_or_default();
            if !bytes.is_empty() {
                match tx.write(bytes).await {
                    // Not offered again at once, which would take all of the processor.
                    Ok(0) => {
                        let until = clock() + FULL_AGAIN;
                        self.full_until.set(until);
                        self.move_on.set(true);
                        yield_now().await;
                        poll_fn(|_| ready_if(clock() >= until)).await;
                        self.full_until.set(Instant::NEVER);
                    }
                    Ok(written) => {
                        self.node(|node| node.consume(written.min(bytes.len())));
                        flushed = false;
                    }
                    Err(error) => return error,
                }
            } else if !flushed {
                if let Err(error) = tx.flush().await {
                    return error;
                }
                flushed = true;
                // The sent frame has a time at which it is repeated.
                self.move_on.set(true);
            } else {
                poll_fn(|_| ready_if(self.send.take())).await;
                continue;
            }
            yield_now().await;
        }
    }
}

fn ready_if(ready: bool) -> Poll<()> {
    match ready {
        true => Poll::Ready(()),
        false => Poll::Pending,
    }
}

/// Yields to the other loops and to other async tasks.
async fn yield_now() {
    let mut yielded = false;
    poll_fn(|context| {
        if yielded {
            return Poll::Ready(());
        }
        yielded = true;
        context.waker().wake_by_ref();
        Poll::Pending
    })
    .await;
}
