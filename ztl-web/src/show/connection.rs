//! Connections of the show that the console watches: its tasks are goals of the console. So a Stop keeps them from being
//! sent, is not confirmed while the answer of one is open, and counts those of a server that lists no tasks; and pages tell
//! who started them.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use ztl_script::Connect;
use ztl_script::server::{Acceptance, Connection, ServerAnswer, ServerRequest};
use ztl_std::{Offers, RemoteId};

use crate::board::{Board, locked};
use crate::goal::Goal;
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
        let place = board.place_of(name);
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
        let may_start = || may_start() && !goal.is_cancelled();
        let answer = self.inner.request(request, &may_start);
        if let ServerAnswer::Started { id, .. } = &answer {
            goal.set_id(id.clone());
            let key = (self.server, self.scope.clone(), id.clone());
            // A server of the original gives an id again when it is started again.
            let earlier = locked(&self.open).insert(key, (number, goal));
            self.close(earlier);
            self.board.publish();
        } else {
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
                let goal = Goal::new(target, goal.clone(), BY.to_owned(), u64::MAX);
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
