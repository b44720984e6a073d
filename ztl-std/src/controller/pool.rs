//! Threads that wait for tasks.
//!
//! A task that blocks keeps its thread and delays nobody: whoever takes one while more are waiting
//! calls another thread first, which is woken, or started if all are busy. A task that is quick costs
//! neither, since its thread comes back and takes the next.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How long a thread waits for a task before it ends.
const IDLE: Duration = Duration::from_secs(10);

/// Something to be done on a thread.
pub(super) trait Job: Send + 'static {
    /// Does it; may take for ever.
    fn run(self);

    /// The system gives no more threads.
    fn refuse(self);
}

/// Threads for jobs, as many as run at a time. Dropped, it starts no more of them; what runs goes
/// on.
pub(super) struct Pool<J: Job>(Arc<Shared<J>>);

struct Shared<J> {
    state: Mutex<State<J>>,
    called: Condvar,
}

struct State<J> {
    waiting: VecDeque<J>,
    /// Threads that wait to be called.
    idle: usize,
    /// Calls that no thread has heard yet.
    calls: usize,
    /// A thread was called or started and has not looked at what is waiting.
    coming: bool,
    closed: bool,
}

impl<J: Job> Pool<J> {
    pub(super) fn new() -> Self {
        let state = State {
            waiting: VecDeque::new(),
            idle: 0,
            calls: 0,
            coming: false,
            closed: false,
        };
        Self(Arc::new(Shared {
            state: Mutex::new(state),
            called: Condvar::new(),
        }))
    }

    /// Hands over some jobs, which are begun in their order; never waits for any.
    pub(super) fn begin(&self, jobs: &mut Vec<J>) {
        let mut state = self.0.lock();
        state.waiting.extend(jobs.drain(..));
        call(&self.0, state);
    }
}

impl<J: Job> Drop for Pool<J> {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        state.closed = true;
        let never = std::mem::take(&mut state.waiting);
        drop(state);
        self.0.called.notify_all();
        drop(never);
    }
}

impl<J> Shared<J> {
    fn lock(&self) -> MutexGuard<'_, State<J>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Makes a thread come, if something is waiting and none is on its way.
fn call<J: Job>(shared: &Arc<Shared<J>>, mut state: MutexGuard<'_, State<J>>) {
    if state.coming || state.waiting.is_empty() {
        return;
    }
    state.coming = true;
    if state.idle > 0 {
        state.idle -= 1;
        state.calls += 1;
        drop(state);
        shared.called.notify_one();
        return;
    }
    drop(state);
    let its = Arc::clone(shared);
    let spawned = std::thread::Builder::new()
        .name("ztl-task".to_owned())
        .spawn(move || work(&its));
    if spawned.is_err() {
        let mut state = shared.lock();
        state.coming = false;
        let refused = std::mem::take(&mut state.waiting);
        drop(state);
        refused.into_iter().for_each(J::refuse);
    }
}

/// What a thread does.
fn work<J: Job>(shared: &Arc<Shared<J>>) {
    let mut state = shared.lock();
    loop {
        // Here it is.
        state.coming = false;
        while let Some(job) = state.waiting.pop_front() {
            call(shared, state);
            job.run();
            state = shared.lock();
        }
        if state.closed {
            return;
        }
        state.idle += 1;
        let nothing = |state: &mut State<J>| state.calls == 0 && !state.closed;
        let waited = shared.called.wait_timeout_while(state, IDLE, nothing);
        state = waited.unwrap_or_else(PoisonError::into_inner).0;
        if state.calls == 0 {
            state.idle -= 1;
            return;
        }
        // Who called has counted it out already.
        state.calls -= 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    struct Work(Box<dyn FnOnce() + Send>);

    impl Job for Work {
        fn run(self) {
            (self.0)();
        }

        fn refuse(self) {}
    }

    fn begin(pool: &Pool<Work>, work: impl FnOnce() + Send + 'static) {
        pool.begin(&mut vec![Work(Box::new(work))]);
    }

    const PATIENCE: Duration = Duration::from_secs(20);

    /// A job that says that it has begun, and ends when it is let go.
    fn blocking(begun: Sender<u32>, number: u32, go: Receiver<()>) -> Work {
        Work(Box::new(move || {
            begun.send(number).unwrap();
            let _ = go.recv();
        }))
    }

    #[test]
    fn jobs_that_block_delay_no_other() {
        let pool = Pool::new();
        let (begun, begins) = channel();
        let (gates, mut jobs): (Vec<_>, Vec<_>) = (0..100)
            .map(|number| {
                let (gate, go) = channel();
                (gate, blocking(begun.clone(), number, go))
            })
            .unzip();
        pool.begin(&mut jobs);
        let mut seen: Vec<u32> = (0..100)
            .map(|_| begins.recv_timeout(PATIENCE).expect("each begins"))
            .collect();
        seen.sort_unstable();
        assert_eq!(seen, (0..100).collect::<Vec<_>>());
        drop(gates);
        // The threads are used again.
        begin(&pool, move || begun.send(100).unwrap());
        assert_eq!(begins.recv_timeout(PATIENCE), Ok(100));
    }

    #[test]
    fn quick_jobs_share_few_threads() {
        let pool = Pool::new();
        let (ran, runs) = channel();
        for _ in 0..1000 {
            let ran = ran.clone();
            begin(&pool, move || {
                ran.send(std::thread::current().id()).unwrap()
            });
            runs.recv_timeout(PATIENCE).expect("each is run");
        }
        drop(ran);
        // One runs and one may be on its way back; a busy machine may need a few more.
        let idle = pool.0.lock().idle;
        assert!(idle <= 10, "{idle} threads");
    }

    #[test]
    fn what_has_not_begun_when_the_pool_is_dropped_never_does() {
        let pool = Pool::new();
        let (ran, runs) = channel::<()>();
        let shared = Arc::clone(&pool.0);
        // As if a thread was on its way, which never comes.
        shared.lock().coming = true;
        begin(&pool, move || ran.send(()).unwrap());
        drop(pool);
        assert!(runs.recv_timeout(PATIENCE).is_err(), "it was dropped");
        assert!(shared.lock().waiting.is_empty());
    }
}
