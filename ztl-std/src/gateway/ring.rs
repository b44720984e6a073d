//! A bounded queue between threads that never makes its writer wait: full, it loses the oldest.

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
    /// Held only while one is put or taken.
    fn inner(&self) -> MutexGuard<'_, Inner<T>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where one is put.
#[derive(Debug)]
pub(super) struct RingIn<T>(Weak<Shared<T>>);

/// Where one is taken; dropped, nothing is kept any more.
#[derive(Debug)]
pub(super) struct RingOut<T>(Arc<Shared<T>>);

/// A queue of at most `capacity`, at least one.
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
    /// Puts one behind the others; says whether anybody is there to take it.
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

/// Why there is none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Empty {
    /// None yet.
    Now,
    /// None, and there will be none.
    ForEver,
}

impl<T> RingOut<T> {
    /// The oldest that was not lost; waits for it, at most for `limit`.
    pub(super) fn take(&self, limit: Duration) -> Result<T, Empty> {
        let start = Instant::now();
        let mut inner = self.0.inner();
        loop {
            if let Some(one) = inner.queue.pop_front() {
                return Ok(one);
            }
            if inner.closed {
                return Err(Empty::ForEver);
            }
            let left = limit.saturating_sub(start.elapsed());
            if left.is_zero() {
                return Err(Empty::Now);
            }
            let waited = self.0.more.wait_timeout(inner, left);
            inner = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// How many were lost since this was asked last.
    pub(super) fn take_lost(&self) -> u64 {
        std::mem::take(&mut self.0.inner().lost)
    }

    /// How many were lost.
    pub(super) fn lost(&self) -> u64 {
        self.0.inner().lost
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_are_lost_and_counted_and_the_end_is_told_after_the_rest() {
        let (put, take) = ring(3);
        for number in 0..10 {
            assert!(put.put(number));
        }
        assert_eq!(take.lost(), 7);
        assert_eq!(take.take(Duration::ZERO), Ok(7));
        drop(put);
        assert_eq!(take.take(Duration::ZERO), Ok(8));
        assert_eq!(take.take(Duration::MAX), Ok(9));
        assert_eq!(take.take(Duration::MAX), Err(Empty::ForEver));
    }

    #[test]
    fn nothing_is_kept_for_nobody() {
        let (put, take) = ring(3);
        assert_eq!(take.take(Duration::from_millis(1)), Err(Empty::Now));
        assert!(put.put(1));
        drop(take);
        assert!(!put.put(2));
    }

    #[test]
    fn who_waits_is_woken() {
        let (put, take) = ring(1);
        let waiting = std::thread::spawn(move || {
            let one = take.take(Duration::from_secs(20));
            (one, take.take(Duration::from_secs(20)))
        });
        assert!(put.put(5));
        drop(put);
        assert_eq!(
            waiting.join().expect("no panic"),
            (Ok(5), Err(Empty::ForEver))
        );
    }
}
