//! The task ids that a journal has reserved, so that none is given twice.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::thread::Thread;

use ztl_core::TaskId;

/// Shared between a server, which gives ids, and a journal, which reserves them before.
#[derive(Debug)]
pub struct ReservedIds {
    /// Those up to this one may be given.
    last: AtomicU32,
    /// Once this one was given, more are to be reserved.
    low: AtomicU32,
    /// The last one that was given, also before a restart.
    given: AtomicU32,
    /// What reserves more.
    reserves: OnceLock<Thread>,
}

impl ReservedIds {
    /// None are reserved yet; ids up to this one were given before.
    #[must_use]
    pub fn after(given: TaskId) -> Self {
        Self {
            last: given.get().into(),
            low: 0.into(),
            given: given.get().into(),
            reserves: OnceLock::new(),
        }
    }

    /// Wakes this thread when more are to be reserved.
    pub fn set_thread(&self, thread: Thread) {
        let _ = self.reserves.set(thread);
    }

    /// More are reserved.
    pub fn reserve(&self, low: u32, last: u32) {
        self.low.store(low, Ordering::Relaxed);
        self.last.store(last, Ordering::Release);
    }

    /// The last one that may be given; never `None`.
    pub(crate) fn last(&self) -> Option<TaskId> {
        TaskId::new(self.last.load(Ordering::Acquire))
    }

    /// The last one that was given.
    #[must_use]
    pub fn given(&self) -> u32 {
        self.given.load(Ordering::Relaxed)
    }

    /// This one is given.
    pub(crate) fn give(&self, id: TaskId) {
        self.given.fetch_max(id.get(), Ordering::Relaxed);
        if id.get() >= self.low.load(Ordering::Relaxed)
            && let Some(thread) = self.reserves.get()
        {
            thread.unpark();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::server::{TaskHandler, TaskReporter, TaskServer};
    use crate::{RemoteTask, TaskRequest};

    struct Reserving(Arc<ReservedIds>);

    impl TaskHandler for Reserving {
        fn start(&mut self, task: TaskReporter, _: TaskRequest) {
            task.completed("");
        }

        fn abort(&mut self, _: TaskId) {}

        fn reserved_ids(&self) -> Option<Arc<ReservedIds>> {
            Some(Arc::clone(&self.0))
        }
    }

    #[test]
    fn a_server_gives_only_reserved_ids_and_all_of_them() {
        let ids = Arc::new(ReservedIds::after(TaskId::new(5).unwrap()));
        let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
        server.register_handler("/test", Reserving(Arc::clone(&ids)));
        let server = server.spawn().unwrap();
        let mut remote = RemoteTask::connect(server.endpoint(), "/test").unwrap();
        let mut given = || {
            let task = remote.trigger("h", "c", "");
            task.map(|task| task.id.number().unwrap().get())
        };
        let refused = given().unwrap_err().to_string();
        assert!(
            refused.contains("no task id is reserved, try again; the server's log says why"),
            "{refused}"
        );
        ids.reserve(6, 7);
        assert_eq!(
            [given().ok(), given().ok(), given().ok()],
            [Some(6), Some(7), None]
        );
        assert_eq!(ids.given(), 7);
    }
}
