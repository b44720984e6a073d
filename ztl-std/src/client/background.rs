//! Runs a task on a thread of its own, as a future for any runtime.

use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use super::error::{RequestError, RunError, TriggerError};
use super::remote_task::RemoteTask;
use super::status::Status;
use crate::task_request::encoded;

/// A running task, as a future for any runtime. Dropping it before the task has ended aborts the task.
///
/// ```no_run
/// # async fn example(robot: ztl_std::RemoteTask) -> Result<(), ztl_std::RunError> {
/// let left = robot.start("arm", "left", "up", None, |progress| println!("left: {progress:?}"));
/// let right = robot.start("arm", "right", "up", None, |_| {});
/// // Both move now.
/// println!("{:?} {:?}", left.await?, right.await?);
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
#[must_use = "dropping it aborts the task"]
pub struct BackgroundTask(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    dropped: AtomicBool,
    state: Mutex<State>,
    ended: Condvar,
}

#[derive(Debug, Default)]
struct State {
    ended: Option<Result<Status, RunError>>,
    waker: Option<Waker>,
}

impl RemoteTask {
    /// Starts a task and waits for its end on a thread and a connection of its own, as [`run`](Self::run) does.
    /// `seen` is called on that thread with each answer, or with the error if there is none.
    pub fn start(
        &self,
        handler: &str,
        component: &str,
        goal: &str,
        limit: Option<Duration>,
        seen: impl FnMut(&Result<Status, RequestError>) + Send + 'static,
    ) -> BackgroundTask {
        let shared = Arc::new(Shared::default());
        let (mut remote, task) = (self.clone(), Arc::clone(&shared));
        let payload = encoded(handler, component, goal);
        let spawned = std::thread::Builder::new()
            .name("ztl-task".to_owned())
            .spawn(move || {
                let dropped = || task.dropped.load(Ordering::Acquire);
                let ended = match remote.trigger_while(&payload, || !dropped()) {
                    Ok(triggered) => {
                        let ended = remote.wait_while(&triggered.id, limit, || !dropped(), seen);
                        if ended.is_err() && dropped() {
                            // The client has logged any error.
                            let _ = remote.send_abort(&triggered.id);
                        }
                        ended.map_err(RunError::NotEnded)
                    }
                    Err(error) => Err(RunError::NotStarted(error)),
                };
                task.end(ended);
            });
        if spawned.is_err() {
            // Nothing was sent.
            let error = TriggerError::Request(RequestError::System("no thread".to_owned()));
            shared.end(Err(RunError::NotStarted(error)));
        }
        BackgroundTask(shared)
    }
}

impl BackgroundTask {
    /// Waits for the end on the current thread.
    ///
    /// # Errors
    /// Those of [`RemoteTask::run`].
    pub fn wait(self) -> Result<Status, RunError> {
        let state = self.0.lock();
        let ended = self
            .0
            .ended
            .wait_while(state, |state| state.ended.is_none());
        let state = ended.unwrap_or_else(PoisonError::into_inner);
        // Never `None` after the wait.
        let never = RunError::NotStarted(TriggerError::NeverCame);
        state.ended.clone().unwrap_or(Err(never))
    }
}

impl Future for BackgroundTask {
    type Output = Result<Status, RunError>;

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Self::Output> {
        let mut state = self.0.lock();
        if let Some(ended) = &state.ended {
            return Poll::Ready(ended.clone());
        }
        state.waker = Some(context.waker().clone());
        Poll::Pending
    }
}

impl Drop for BackgroundTask {
    fn drop(&mut self) {
        self.0.dropped.store(true, Ordering::Release);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end(&self, ended: Result<Status, RunError>) {
        let mut state = self.lock();
        state.ended = Some(ended);
        if let Some(waker) = state.waker.take() {
            waker.wake();
        }
        self.ended.notify_all();
    }
}
