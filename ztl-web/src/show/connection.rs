//! Connections of the show that the console watches: its tasks are goals of the console. So a Stop keeps them from being
//! sent, is not confirmed while the answer of one is open, and counts those of a server that lists no tasks; and pages tell
//! who started them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::thread;

use ztl_script::Connect;
use ztl_script::server::{Acceptance, Connection, ServerAnswer, ServerRequest};
use ztl_std::{Offers, RemoteId};

use crate::board::Board;
use crate::clock::now_ms;
use crate::goal::{Goal, LATEST_MS};
use crate::goals::{self, ASK_AGAIN};
use crate::lock::locked;
use crate::robots::Target;

/// Who starts the tasks of the show, for people.
const BY: &str = "the show";

/// The tasks of the show that are not known to have ended, by server, scope and id, with their numbers on the board.
type Open = Arc<Mutex<HashMap<(usize, String, RemoteId), (u64, Arc<Goal>)>>>;

struct Watched {
    inner: Box<dyn Connection>,
    board: Arc<Board>,
    open: Open,
    server: usize,
    scope: String,
}

/// Watches the connections that are made.
pub(super) fn watched(mut connect: Connect, board: &Arc<Board>) -> Connect {
    let (board, open) = (Arc::clone(board), Open::default());
    Box::new(move |name| {
        let inner = connect(name)?;
        let place = board.locate(name);
        let (server, scope) = place.ok_or_else(|| format!("the console has no robot '{name}'"))?;
        Ok(Box::new(Watched {
            inner,
            board: Arc::clone(&board),
            open: Arc::clone(&open),
            server,
            scope,
        }))
    })
}

impl Watched {
    fn init(
        &mut self,
        request: &ServerRequest,
        may_start: &dyn Fn() -> bool,
        goal: Goal,
    ) -> ServerAnswer {
        let goal = Arc::new(goal);
        let Some(number) = self.board.add_goal(&goal, usize::MAX) else {
            return ServerAnswer::Withdrawn;
        };
        let may_start = || may_start() && !goal.is_cancelled() && !goal.is_late();
        let mut answer = self.inner.request(request, &may_start);
        // What starts later than anybody expects is aborted. Until that is decided, the task counts as under way: its cue or
        // scene does not start again, and no Stop is confirmed.
        while is_open(&answer) {
            goal.give_up();
            let Some(told) = self.inner.outcome() else {
                break;
            };
            answer = told;
            if is_open(&answer) {
                thread::sleep(ASK_AGAIN);
            }
        }
        if goal.is_answer_late() {
            goal.give_up();
        }
        if let ServerAnswer::Started { id, .. } = &answer {
            goal.set_id(id.clone());
            if goal.is_cancelled()
                && let Err(why) = goals::abort(&goal, id, &self.board)
            {
                tracing::error!("task {id} was not aborted: {why}");
            }
            let key = (self.server, self.scope.clone(), id.clone());
            // A server of the original gives an id again when it is started again.
            let earlier = locked(&self.open).insert(key, (number, goal));
            self.close(earlier);
            self.board.publish();
        } else {
            // Before it is settled: a Stop that sees that counts it.
            if is_open(&answer) {
                self.board.lose_without_id(self.server);
            }
            self.close(Some((number, goal)));
        }
        answer
    }

    /// A task has ended, or nobody can tell.
    fn close(&self, task: Option<(u64, Arc<Goal>)>) {
        if let Some((number, goal)) = task {
            goal.settle();
            goal.end();
            self.board.remove_goal(number);
        }
    }
}

/// Whether an INIT with this answer may have started, or may start, a task that nobody knows.
const fn is_open(answer: &ServerAnswer) -> bool {
    matches!(
        answer,
        ServerAnswer::Nothing { sent: true, .. }
            | ServerAnswer::Unclear { .. }
            | ServerAnswer::NotTold { .. }
    )
}

impl Connection for Watched {
    fn request(&mut self, request: &ServerRequest, may_start: &dyn Fn() -> bool) -> ServerAnswer {
        let id = match request {
            ServerRequest::Init {
                handler,
                component,
                goal,
            } => {
                let target = Target {
                    server: self.server,
                    scope: self.scope.clone(),
                    handler: handler.clone(),
                    component: component.clone(),
                };
                let goal = Goal::new(target, goal.clone(), BY.to_owned(), now_ms() + LATEST_MS);
                return self.init(request, may_start, goal);
            }
            ServerRequest::Status { id, .. } | ServerRequest::Abort { id } => Some(id),
            ServerRequest::Probe | ServerRequest::Tasks => None,
        };
        let answer = self.inner.request(request, may_start);
        let is_over = match &answer {
            ServerAnswer::Task { state, .. } => state.is_final(),
            ServerAnswer::TaskUnknown { .. } => true,
            _ => false,
        };
        if let Some(id) = id.filter(|_| is_over) {
            let key = (self.server, self.scope.clone(), id.clone());
            let ended = locked(&self.open).remove(&key);
            self.close(ended);
        }
        answer
    }

    fn offers(&mut self) -> Option<Offers> {
        self.inner.offers()
    }

    fn would_accept(&mut self, handler: &str, component: &str, goal: &str) -> Acceptance {
        self.inner.would_accept(handler, component, goal)
    }
}
