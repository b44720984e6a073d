//! Connections of the show that the console watches: a task that the show is about to send is a goal of the console, so
//! that a Stop keeps it from being sent, and is not confirmed while its answer is open.

use std::sync::Arc;

use ztl_script::Connect;
use ztl_script::server::{Acceptance, Connection, ServerAnswer, ServerRequest};
use ztl_std::Offers;

use crate::board::Board;
use crate::goal::Goal;
use crate::robots::Target;

/// Who starts the tasks of the show, for people.
const BY: &str = "the show";

struct Watched {
    inner: Box<dyn Connection>,
    board: Arc<Board>,
    server: usize,
    scope: String,
}

/// Watches the connections that are made.
pub(super) fn watched(mut connect: Connect, board: &Arc<Board>) -> Connect {
    let board = Arc::clone(board);
    Box::new(move |name| {
        let inner = connect(name)?;
        let place = board.place_of(name);
        let (server, scope) = place.ok_or_else(|| format!("the console has no robot '{name}'"))?;
        let board = Arc::clone(&board);
        Ok(Box::new(Watched {
            inner,
            board,
            server,
            scope,
        }))
    })
}

impl Connection for Watched {
    fn request(&mut self, request: &ServerRequest, may_start: &dyn Fn() -> bool) -> ServerAnswer {
        let ServerRequest::Init {
            handler,
            component,
            goal,
        } = request
        else {
            return self.inner.request(request, may_start);
        };
        let target = Target {
            server: self.server,
            scope: self.scope.clone(),
            handler: handler.clone(),
            component: component.clone(),
        };
        let goal = Goal::new(target, goal.clone(), BY.to_owned(), u64::MAX);
        let goal = Arc::new(goal);
        let Some(number) = self.board.add_goal(&goal, usize::MAX) else {
            return ServerAnswer::Withdrawn;
        };
        let may_start = || may_start() && !goal.is_cancelled();
        let answer = self.inner.request(request, &may_start);
        if let ServerAnswer::Started { id, .. } = &answer {
            goal.set_id(id.clone());
        }
        goal.settle();
        goal.end();
        self.board.remove_goal(number);
        answer
    }

    fn offers(&mut self) -> Option<Offers> {
        self.inner.offers()
    }

    fn would_accept(&mut self, handler: &str, component: &str, goal: &str) -> Acceptance {
        self.inner.would_accept(handler, component, goal)
    }
}
