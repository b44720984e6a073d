//! Restored tasks of any handler, not only of the gateway.

use std::sync::{Arc, Mutex};
use ztl_tests::lab::{LIMIT, connect_to, status};

use std::time::Duration;
use ztl_std::server::{Restored, RestoredTask, TaskHandler, TaskReporter};
use ztl_std::{RequestError, State, TaskId};
use ztl_std::{TaskRequest, TaskServer};

/// Accepts tasks that never end, and tasks that it must restore.
struct Remembering {
    restored: Restored,
    running: Arc<Mutex<Vec<TaskReporter>>>,
}

impl TaskHandler for Remembering {
    fn start(&mut self, task: TaskReporter, _request: TaskRequest) {
        task.accepted("taken");
        self.running.lock().unwrap().push(task);
    }

    fn abort(&mut self, _id: TaskId) {}

    fn restored(&mut self) -> Restored {
        std::mem::take(&mut self.restored)
    }

    fn resume(&mut self, task: TaskReporter) {
        self.running.lock().unwrap().push(task);
    }
}

fn id(number: u32) -> TaskId {
    TaskId::new(number).unwrap()
}

fn task(number: u32, state: State, ended: Option<u64>) -> RestoredTask {
    RestoredTask {
        id: id(number),
        payload: String::new(),
        state,
        text: format!("of {number}"),
        ended: ended.map(Duration::from_secs),
        by_device: false,
    }
}

#[test]
fn tasks_are_restored_to_their_scopes_in_any_order_of_registration() {
    // Above every id that a server starts with.
    let first = 2_000_000_000;
    for reversed in [false, true] {
        let running = Arc::default();
        let handler = |tasks, last| Remembering {
            restored: Restored {
                tasks,
                last_id: Some(id(last)),
            },
            running: Arc::clone(&running),
        };
        let a = handler(
            vec![
                task(first + 1, State::Aborted, Some(3599)),
                task(first + 2, State::Accepted, None),
                task(first + 3, State::Completed, Some(3601)),
                // Before the server started.
                task(first + 4, State::Completed, Some(1_000_000)),
            ],
            first + 9,
        );
        let b = handler(vec![task(first + 5, State::Failed, Some(0))], first + 50);
        let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
        let mut scopes = vec![("/a", a), ("/b", b)];
        if reversed {
            scopes.reverse();
        }
        for (scope, handler) in scopes {
            server.register_handler(scope, handler);
        }
        let server = server.spawn().unwrap();
        let connect = |scope| connect_to(server.endpoint(), scope);
        let (mut a, mut b) = (connect("/a"), connect("/b"));
        let of = |number, state| Ok(status(state, &format!("of {number}")));
        let unknown = |number: u32| {
            Err(RequestError::UnknownTask {
                id: id(number).into(),
                text: format!("Invalid ID '{number}'"),
            })
        };
        let (ended, runs, long_ago) = (first + 1, first + 2, first + 3);
        assert_eq!(a.status(id(ended)), of(ended, State::Aborted));
        assert_eq!(a.status(id(runs)), of(runs, State::Accepted));
        assert_eq!(b.status(id(runs)), unknown(runs));
        assert_eq!(b.status(id(first + 5)), of(first + 5, State::Failed));
        for forgotten in [long_ago, first + 4] {
            assert_eq!(a.status(id(forgotten)), unknown(forgotten));
        }
        let next = b.trigger("h", "c", "g").unwrap().id;
        assert_eq!(next, id(first + 51));
        let place = |task: &TaskReporter| task.id() == id(runs);
        let mut running = running.lock().unwrap();
        let task = running.iter().position(place).unwrap();
        running.remove(task).completed("at last");
        assert_eq!(
            a.wait(id(runs), LIMIT),
            Ok(status(State::Completed, "at last"))
        );
    }
}
