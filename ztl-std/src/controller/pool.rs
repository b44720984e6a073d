//! Threads that wait for tasks.
//!
//! A task that blocks keeps its thread and delays nobody: whoever takes one while more are waiting
//! calls another thread first, which is woken, or started if all are busy. A task that is quick costs
//! neither, since its thread comes back and takes the next.
//!
//! Where quick tasks come by the dozen, calling would cost more than they do. So one who was called and
//! finds nothing left stays on watch for a while: as long as it does, nobody calls, and it steps in itself
//! when a task has waited from one look to the next.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Thread;
use std::time::{Duration, Instant};

/// How long a thread waits for a task before it ends.
const IDLE: Duration = Duration::from_secs(10);

/// From one look of the thread on watch to its next. A task behind one that blocks waits for two at most.
const LOOK: Duration = Duration::from_micros(500);

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
}

struct State<J> {
    waiting: VecDeque<J>,
    /// How many were begun, ever.
    begun: u64,
    /// Threads that wait to be called, which is to be taken out of here. The last to come is called
    /// first: what it needs is still at hand.
    idle: Vec<Thread>,
    /// A thread was called or started and has not looked at what is waiting.
    coming: bool,
    /// A job was begun while more were waiting, since the thread on watch looked.
    crowded: bool,
    /// A thread is on watch.
    watched: bool,
    closed: bool,
}

impl<J: Job> Pool<J> {
    pub(super) fn new() -> Self {
        let state = State {
            waiting: VecDeque::new(),
            begun: 0,
            idle: Vec::new(),
            coming: false,
            crowded: false,
            watched: false,
            closed: false,
        };
        Self(Arc::new(Shared {
            state: Mutex::new(state),
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

/// Makes a thread come, if something is waiting and none is on its way.
fn call<J: Job>(shared: &Arc<Shared<J>>, mut state: MutexGuard<'_, State<J>>) {
    if state.coming || state.waiting.is_empty() {
        return;
    }
    state.coming = true;
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
        state.coming = false;
        let refused = std::mem::take(&mut state.waiting);
        drop(state);
        refused.into_iter().for_each(J::refuse);
    }
}

/// What a thread does.
fn work<J: Job>(shared: &Arc<Shared<J>>) {
    let mut state = shared.lock();
    // Here it is.
    state.coming = false;
    loop {
        while let Some(job) = state.waiting.pop_front() {
            state.begun += 1;
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
        state.coming = false;
    }
}

/// Until a job has waited from one look to the next, which is to be begun now, or none has waited for
/// another since the last look.
fn watch<'s, J>(
    shared: &'s Shared<J>,
    mut state: MutexGuard<'s, State<J>>,
) -> MutexGuard<'s, State<J>> {
    state.watched = true;
    loop {
        let all = state.begun + state.waiting.len() as u64;
        state.crowded = false;
        drop(state);
        std::thread::sleep(LOOK);
        state = shared.lock();
        if state.begun < all || !state.crowded || state.closed {
            state.watched = false;
            return state;
        }
    }
}

/// Waits to be called; `None` when nobody has for too long, or nobody will.
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
        let idle = pool.0.lock().idle.len();
        assert!(idle <= 10, "{idle} threads");
    }

    #[test]
    fn a_job_that_blocks_delays_no_other_while_quick_ones_are_watched_either() {
        let pool = Pool::new();
        let (ran, runs) = channel();
        let quick = |number: u32| {
            let ran = ran.clone();
            Work(Box::new(move || ran.send(number).unwrap()))
        };
        let start = Instant::now();
        while !pool.0.lock().watched {
            assert!(start.elapsed() < PATIENCE, "nobody watches");
            pool.begin(&mut (0..50).map(quick).collect());
            for _ in 0..50 {
                runs.recv_timeout(PATIENCE).expect("each is run");
            }
        }
        let (begun, begins) = channel();
        let (gate, go) = channel();
        let mut jobs: Vec<Work> = (0..50).map(quick).collect();
        jobs.insert(0, blocking(begun, 7, go));
        pool.begin(&mut jobs);
        assert_eq!(begins.recv_timeout(PATIENCE), Ok(7));
        let mut seen: Vec<u32> = (0..50)
            .map(|_| runs.recv_timeout(PATIENCE).expect("each is run"))
            .collect();
        seen.sort_unstable();
        assert_eq!(seen, (0..50).collect::<Vec<_>>());
        drop(gate);
        // Nobody watches for ever.
        let start = Instant::now();
        while pool.0.lock().watched {
            assert!(start.elapsed() < PATIENCE, "somebody still watches");
            std::thread::yield_now();
        }
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
