//! A thread pool without a limit: a job that blocks delays no other.
//!
//! A thread that takes a job while more are waiting first calls another thread, which is woken, or started
//! if all are busy. A quick job needs neither, since its thread takes the next one. Measured with 16 clients on
//! two cores, an INIT takes 16 µs of CPU; with a new thread for each task it takes 53 µs.
//!
//! Many quick jobs would spend most time on calling threads. So a thread that was called and finds no job
//! left keeps watch for a while: meanwhile no thread calls another, and the watching one takes over when a job
//! has waited from one check to the next. Without the watch, the rate of INITs is about 25 % lower.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

/// How long an idle thread waits for a job before it ends.
const IDLE: Duration = Duration::from_secs(10);

/// Time between two checks of the watching thread. A job behind one that blocks waits for two at most.
const CHECK: Duration = Duration::from_micros(500);

/// Something to run on a thread.
pub(super) trait Job: Send + 'static {
    /// Runs it, however long it takes.
    fn run(self);

    /// The system has no more threads.
    fn reject(self);
}

/// The pool. Dropping it discards the waiting jobs; running ones continue.
pub(super) struct Pool<J: Job>(Arc<Shared<J>>);

struct Shared<J> {
    state: Mutex<State<J>>,
}

struct State<J> {
    waiting: VecDeque<J>,
    /// Jobs started so far.
    started: u64,
    /// Idle threads. A thread is called by removing it; the latest first, since its data is still cached.
    idle: Vec<Thread>,
    /// A thread was called or started and has not looked for jobs yet.
    called: bool,
    /// A job was started while more were waiting, since the last check.
    crowded: bool,
    /// A thread keeps watch.
    watched: bool,
    closed: bool,
}

impl<J: Job> Pool<J> {
    pub(super) fn new() -> Self {
        let state = State {
            waiting: VecDeque::new(),
            started: 0,
            idle: Vec::new(),
            called: false,
            crowded: false,
            watched: false,
            closed: false,
        };
        Self(Arc::new(Shared {
            state: Mutex::new(state),
        }))
    }

    /// Runs jobs, started in order. Never waits for one.
    pub(super) fn run(&self, jobs: &mut Vec<J>) {
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
        let idle = std::mem::take(&mut state.idle);
        drop(state);
        idle.iter().for_each(Thread::unpark);
        drop(never);
    }
}

impl<J> Shared<J> {
    fn lock(&self) -> MutexGuard<'_, State<J>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Calls a thread, if a job is waiting and no thread was called.
fn call<J: Job>(shared: &Arc<Shared<J>>, mut state: MutexGuard<'_, State<J>>) {
    if state.called || state.waiting.is_empty() {
        return;
    }
    state.called = true;
    if let Some(thread) = state.idle.pop() {
        drop(state);
        thread.unpark();
        return;
    }
    drop(state);
    let its = Arc::clone(shared);
    let spawned = std::thread::Builder::new()
        .name("ztl-task".to_owned())
        .spawn(move || work(&its));
    if spawned.is_err() {
        let mut state = shared.lock();
        state.called = false;
        let rejected = std::mem::take(&mut state.waiting);
        drop(state);
        rejected.into_iter().for_each(J::reject);
    }
}

/// The loop of a thread.
fn work<J: Job>(shared: &Arc<Shared<J>>) {
    let mut state = shared.lock();
    state.called = false;
    loop {
        while let Some(job) = state.waiting.pop_front() {
            state.started += 1;
            state.crowded |= !state.waiting.is_empty();
            if state.watched {
                drop(state);
            } else {
                call(shared, state);
            }
            job.run();
            state = shared.lock();
        }
        if state.closed {
            return;
        }
        if state.crowded && !state.watched {
            state = watch(shared, state);
            continue;
        }
        match rest(shared, state) {
            Some(called) => state = called,
            None => return,
        }
        state.called = false;
    }
}

/// Keeps watch until a job has waited from one check to the next, or none has waited since the last one.
fn watch<'s, J>(
    shared: &'s Shared<J>,
    mut state: MutexGuard<'s, State<J>>,
) -> MutexGuard<'s, State<J>> {
    state.watched = true;
    loop {
        let all = state.started + state.waiting.len() as u64;
        state.crowded = false;
        drop(state);
        std::thread::sleep(CHECK);
        state = shared.lock();
        if state.started < all || !state.crowded || state.closed {
            state.watched = false;
            return state;
        }
    }
}

/// Waits to be called; `None` if the thread is to end.
fn rest<'s, J>(
    shared: &'s Shared<J>,
    mut state: MutexGuard<'s, State<J>>,
) -> Option<MutexGuard<'s, State<J>>> {
    let me = std::thread::current();
    let start = Instant::now();
    state.idle.push(me.clone());
    loop {
        drop(state);
        let waited = start.elapsed();
        std::thread::park_timeout(IDLE.saturating_sub(waited));
        state = shared.lock();
        // Called, or the pool is closed.
        let Some(place) = state.idle.iter().rposition(|idle| idle.id() == me.id()) else {
            return (!state.closed).then_some(state);
        };
        if waited >= IDLE {
            state.idle.remove(place);
            return None;
        }
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

        fn reject(self) {}
    }

    fn begin(pool: &Pool<Work>, work: impl FnOnce() + Send + 'static) {
        pool.run(&mut vec![Work(Box::new(work))]);
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
        pool.run(&mut jobs);
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
        let idle = pool.0.lock().idle.len();
        assert!(idle <= 10, "{idle} threads");
    }

    #[test]
    fn a_job_that_blocks_delays_no_other_while_a_thread_watches() {
        let pool = Pool::new();
        let (ran, runs) = channel();
        let quick = |number: u32| {
            let ran = ran.clone();
            Work(Box::new(move || ran.send(number).unwrap()))
        };
        let start = Instant::now();
        while !pool.0.lock().watched {
            assert!(start.elapsed() < PATIENCE, "no thread watches");
            pool.run(&mut (0..50).map(quick).collect());
            for _ in 0..50 {
                runs.recv_timeout(PATIENCE).expect("each is run");
            }
        }
        let (begun, begins) = channel();
        let (gate, go) = channel();
        let mut jobs: Vec<Work> = (0..50).map(quick).collect();
        jobs.insert(0, blocking(begun, 7, go));
        pool.run(&mut jobs);
        assert_eq!(begins.recv_timeout(PATIENCE), Ok(7));
        let mut seen: Vec<u32> = (0..50)
            .map(|_| runs.recv_timeout(PATIENCE).expect("each is run"))
            .collect();
        seen.sort_unstable();
        assert_eq!(seen, (0..50).collect::<Vec<_>>());
        drop(gate);
        // The watch ends.
        let start = Instant::now();
        while pool.0.lock().watched {
            assert!(start.elapsed() < PATIENCE, "a thread still watches");
            std::thread::yield_now();
        }
    }

    #[test]
    fn jobs_that_wait_when_the_pool_is_dropped_are_discarded() {
        let pool = Pool::new();
        let (ran, runs) = channel::<()>();
        let shared = Arc::clone(&pool.0);
        // As if a thread was called that never comes.
        shared.lock().called = true;
        begin(&pool, move || ran.send(()).unwrap());
        drop(pool);
        assert!(runs.recv_timeout(PATIENCE).is_err(), "it was dropped");
        assert!(shared.lock().waiting.is_empty());
    }
}
