//! A bounded queue between threads whose writer never waits: when full, it drops the oldest item.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

#[derive(Debug)]
struct Inner<T> {
    queue: VecDeque<T>,
    lost: u64,
    closed: bool,
}

#[derive(Debug)]
struct Shared<T> {
    inner: Mutex<Inner<T>>,
    more: Condvar,
    capacity: usize,
}

impl<T> Shared<T> {
    /// Locked only while an item is put or taken.
    fn inner(&self) -> MutexGuard<'_, Inner<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The writer's end.
#[derive(Debug)]
pub(super) struct RingIn<T>(Weak<Shared<T>>);

/// The reader's end. After it is dropped, the queue keeps nothing.
#[derive(Debug)]
pub(super) struct RingOut<T>(Arc<Shared<T>>);

/// Creates a queue of at most `capacity` items, at least one.
pub(super) fn ring<T>(capacity: usize) -> (RingIn<T>, RingOut<T>) {
    let shared = Arc::new(Shared {
        inner: Mutex::new(Inner {
            queue: VecDeque::new(),
            lost: 0,
            closed: false,
        }),
        more: Condvar::new(),
        capacity: capacity.max(1),
    });
    (RingIn(Arc::downgrade(&shared)), RingOut(shared))
}

impl<T> RingIn<T> {
    /// Appends an item; returns whether there is still a reader.
    pub(super) fn put(&self, one: T) -> bool {
        let Some(shared) = self.0.upgrade() else {
            return false;
        };
        let mut inner = shared.inner();
        if inner.queue.len() >= shared.capacity {
            inner.queue.pop_front();
            inner.lost += 1;
        }
        inner.queue.push_back(one);
        shared.more.notify_one();
        true
    }
}

impl<T> Drop for RingIn<T> {
    fn drop(&mut self) {
        if let Some(shared) = self.0.upgrade() {
            shared.inner().closed = true;
            shared.more.notify_all();
        }
    }
}

/// Why there is no item.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Empty {
    /// There is none yet.
    Now,
    /// The writer is gone.
    Forever,
}

impl<T> RingOut<T> {
    /// Takes the oldest item; waits for one at most for `limit`.
    pub(super) fn take(&self, limit: Duration) -> Result<T, Empty> {
        let start = Instant::now();
        let mut inner = self.0.inner();
        loop {
            if let Some(one) = inner.queue.pop_front() {
                return Ok(one);
            }
            if inner.closed {
                return Err(Empty::Forever);
            }
            let left = limit.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Err(Empty::Now);
            }
            let waited = self.0.more.wait_timeout(inner, left);
            inner = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// How many items were lost since the last call.
    pub(super) fn take_lost(&self) -> u64 {
        std::mem::take(&mut self.0.inner().lost)
    }

    /// How many items were lost.
    pub(super) fn lost(&self) -> u64 {
        self.0.inner().lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_drops_and_counts_the_oldest() {
        let (put, take) = ring(3);
        for number in 0..10 {
            assert!(put.put(number));
        }
        assert_eq!(take.lost(), 7);
        assert_eq!(take.take(Duration::ZERO), Ok(7));
        drop(put);
        assert_eq!(take.take(Duration::ZERO), Ok(8));
        assert_eq!(take.take(Duration::MAX), Ok(9));
        assert_eq!(take.take(Duration::MAX), Err(Empty::Forever));
    }

    #[test]
    fn nothing_is_kept_without_a_reader() {
        let (put, take) = ring(3);
        assert_eq!(take.take(Duration::from_millis(1)), Err(Empty::Now));
        assert!(put.put(1));
        drop(take);
        assert!(!put.put(2));
    }

    #[test]
    fn a_waiting_reader_is_woken() {
        let (put, take) = ring(1);
        let waiting = std::thread::spawn(move || {
            let one = take.take(Duration::from_secs(20));
            (one, take.take(Duration::from_secs(20)))
        });
        assert!(put.put(5));
        drop(put);
        assert_eq!(
            waiting.join().expect("no panic"),
            (Ok(5), Err(Empty::Forever))
        );
    }
}
