//! A task that is run on a thread of its own, as a future for any runtime, or to be waited for.

use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use super::{RemoteTask, RequestError, Status, TriggerError, WaitError};

/// What became of a task that was asked for and waited for.
pub type Fate = Result<Result<Status, WaitError>, TriggerError>;

/// A task that runs, as a future that needs no certain runtime. Dropped before the task has ended, it
/// aborts the task.
///
/// ```no_run
/// # async fn example(robot: ztl_std::RemoteTask) -> Result<(), ztl_std::TriggerError> {
/// let left = robot.start("arm", "left", "up", None, |progress| println!("left: {progress:?}"));
/// let right = robot.start("arm", "right", "up", None, |_| {});
/// // Both move now.
/// println!("{:?} {:?}", left.await?, right.await?);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
#[must_use = "dropped, it aborts its task"]
pub struct InBackground(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    given_up: AtomicBool,
    state: Mutex<State>,
    ended: Condvar,
}

#[derive(Debug, Default)]
struct State {
    fate: Option<Fate>,
    waker: Option<Waker>,
}

impl RemoteTask {
    /// Asks for a task and waits for its end on a thread of its own, with a connection of its own;
    /// `seen` is shown each answer, or its absence, on that thread. The limit and the result are as
    /// [`run`](Self::run)'s.
    pub fn start(
        &self,
        handler: &str,
        component: &str,
        goal: &str,
        limit: Option<Duration>,
        mut seen: impl FnMut(&Result<Status, RequestError>) + Send + 'static,
    ) -> InBackground {
        let shared = Arc::new(Shared::default());
        let (mut remote, told) = (self.clone(), Arc::clone(&shared));
        let payload = super::encoded(handler, component, goal);
        let spawned = std::thread::Builder::new()
            .name("ztl-task".to_owned())
            .spawn(move || {
                let given_up = || told.given_up.load(Ordering::Acquire);
                let triggered = remote.trigger_while(&payload, || !given_up());
                let fate = triggered.map(|task| {
                    let end = remote.wait_with(&task.id, limit, |answer| {
                        seen(answer);
                        !given_up()
                    });
                    if end.is_err() && given_up() {
                        // There is nobody to be told any more; what went wrong is logged.
                        let _ = remote.send_abort(&task.id);
                    }
                    end
                });
                told.tell(fate);
            });
        if spawned.is_err() {
            // Nothing was sent.
            let error = RequestError::Transport(zmq::Error::EAGAIN);
            shared.tell(Err(TriggerError::Request(error)));
        }
        InBackground(shared)
    }
}

impl InBackground {
    /// Waits for the end on this thread.
    ///
    /// # Errors
    /// As [`RemoteTask::run`].
    pub fn wait(self) -> Fate {
        let state = self.0.lock();
        let ended = self.0.ended.wait_while(state, |state| state.fate.is_none());
        let state = ended.unwrap_or_else(PoisonError::into_inner);
        // It is there: that was waited for.
        state.fate.clone().unwrap_or(Err(TriggerError::NeverCame))
    }
}

impl Future for InBackground {
    type Output = Fate;

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Fate> {
        let mut state = self.0.lock();
        if let Some(fate) = &state.fate {
            return Poll::Ready(fate.clone());
        }
        state.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

impl Drop for InBackground {
    fn drop(&mut self) {
        self.0.given_up.store(true, Ordering::Release);
    }
}

impl Shared {
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn tell(&self, fate: Fate) {
        let mut state = self.lock();
        state.fate = Some(fate);
        if let Some(waker) = state.waker.take() {
            waker.wake();
        }
        self.ended.notify_all();
    }
}
