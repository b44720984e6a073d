//! The table of `docs/protocol.md` [4.1], and the scope `$ztl` (section 11), as traces.

mod places;
mod repeated_inits;

use super::*;
use crate::envelope::ClientId;
use crate::memory::{Fixed, Scope};
use crate::tasks::Task;
use std::string::{String, ToString};
use std::vec::Vec;

/// The reply to a client for which there is no room.
const MANY_CLIENTS: &str = "too many clients at a time, try again in a minute";

/// A server on virtual time. A client is a number; replies are collected as text.
struct TestServer {
    dispatcher: Dispatcher<Fixed<u8, 2, 3, 16, 2>>,
    now: Instant,
    answers: Vec<(u8, String)>,
}

impl TestServer {
    fn new() -> Self {
        let memory = Fixed::new(["/test", "/other"]);
        let config = Config::new(TaskId::new(1).unwrap(), 4711);
        Self {
            dispatcher: Dispatcher::new(memory, config),
            now: Instant::ZERO,
            answers: Vec::new(),
        }
    }

    fn handle(
        &mut self,
        peer: u8,
        envelope: Option<Envelope>,
        body: Body<'_>,
    ) -> Option<(&'static str, u32)> {
        let answers = &mut self.answers;
        let mut out = |peer, reply: &Reply<'_>| answers.push((peer, text(reply)));
        let action = self
            .dispatcher
            .handle_request(self.now, peer, envelope, body, &mut out)?;
        Some(match action {
            Action::Start { id, .. } => ("start", id.get()),
            Action::Abort { id, .. } => ("abort", id.get()),
        })
    }

    fn ask(&mut self, peer: u8, request: &str) -> Option<(&'static str, u32)> {
        self.handle(peer, None, Body::One(request.as_bytes()))
    }

    fn event(&mut self, id: u32, event: TaskEvent<'_>) {
        let answers = &mut self.answers;
        let mut out = |peer, reply: &Reply<'_>| answers.push((peer, text(reply)));
        let id = TaskId::new(id).unwrap();
        self.dispatcher.handle_event(self.now, id, event, &mut out);
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(wake) = self.dispatcher.poll_timeout().filter(|wake| *wake <= end) {
            self.now = self.now.max(wake);
            let answers = &mut self.answers;
            let mut out = |peer, reply: &Reply<'_>| answers.push((peer, text(reply)));
            self.dispatcher.handle_timeout(self.now, &mut out);
        }
        self.now = end;
    }

    #[track_caller]
    fn told(&mut self, expected: &[(u8, &str)]) {
        let told: Vec<_> = self.answers.iter().map(|(p, t)| (*p, t.as_str())).collect();
        assert_eq!(told, expected);
        self.answers.clear();
    }

    #[track_caller]
    fn accepted(&mut self, id: u32) {
        assert_eq!(self.ask(1, "/test;1;-1;x"), Some(("start", id)));
        self.event(id, TaskEvent::Accepted { reply: "ok" });
        self.told(&[(1, &std::format!("/test;1;{id};ok"))]);
    }
}

fn text(reply: &Reply<'_>) -> String {
    let mut out = Vec::new();
    reply.put(&mut |bytes: &[u8]| out.extend_from_slice(bytes));
    String::from_utf8(out).unwrap()
}

#[test]
fn every_malformed_request_is_answered_and_the_next_valid_one_is_served() {
    for (request, answer) in [
        (&b""[..], ";2;-1;Unknown protocol"),
        (b"x", "x;2;-1;Unknown protocol"),
        (b"/test;1;1", "/test;2;-1;Unknown protocol"),
        (b"/test;1;-1;\xc3\x28", "/test;2;-1;Unknown protocol"),
        (b"\xff\xfe;1;2;x", ";2;-1;Unknown protocol"),
        (b"/test;x;1;p", "/test;2;-1;Invalid request"),
        (b"/test;2;;p", "/test;2;-1;Invalid request"),
        (b"/test;1.0;1;p", "/test;2;-1;Invalid request"),
        (b"/test;9;1;x", "/test;2;1;Invalid request"),
        (b"/test;-1; 1_0 ;x", "/test;2;10;Invalid request"),
        (b"/nope;1;-1;x", "/nope;2;-1;No controller for scope: /nope"),
        (b"/nope;x;y;z", "/nope;2;-1;No controller for scope: /nope"),
        (
            b"/test/;2;1;x",
            "/test/;2;-1;No controller for scope: /test/",
        ),
        (b";1;-1;x", ";2;-1;No controller for scope: "),
        (b"/test;2;99;x", "/test;2;99;Invalid ID '99'"),
        (b"/test;2; 1_0 ;x", "/test;2;10;Invalid ID '10'"),
        (b"/test;2;0;x", "/test;2;0;Invalid ID '0'"),
        (b"/test;3;-7;x", "/test;2;-7;Invalid ID '-7'"),
        (
            b"/test;2;99999999999999999999;x",
            "/test;2;99999999999999999999;Invalid ID '99999999999999999999'",
        ),
    ] {
        let mut server = TestServer::new();
        assert_eq!(server.handle(7, None, Body::One(request)), None);
        server.told(&[(7, answer)]);
        server.accepted(1);
    }
    let mut server = TestServer::new();
    server.handle(7, None, Body::Several);
    server.told(&[(7, ";2;-1;Unknown protocol")]);
    let digits = "9".repeat(5000);
    server.ask(7, &std::format!("/test;2;{digits};x"));
    server.told(&[(7, "/test;2;-1;Invalid request")]);
}

#[test]
fn a_task_is_started_queried_and_completed() {
    let mut server = TestServer::new();
    assert_eq!(server.ask(1, "/test;1;-1;x"), Some(("start", 1)));
    server.told(&[]);
    server.event(1, TaskEvent::Accepted { reply: "Initiated" });
    server.told(&[(1, "/test;1;1;Initiated")]);
    server.ask(2, "/test;2;1;a;b;c");
    server.told(&[(2, "/test;1;1;None")]);
    server.event(1, TaskEvent::Progress { text: "half" });
    server.ask(2, "/test;2;1;");
    server.told(&[(2, "/test;1;1;half")]);
    server.event(1, TaskEvent::Completed { result: "done" });
    server.ask(2, "/test;2;1;");
    server.told(&[(2, "/test;5;1;done")]);
}

#[test]
fn a_task_is_unknown_under_another_scope() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ask(2, "/other;2;1;");
    server.told(&[(2, "/other;2;1;Invalid ID '1'")]);
}

#[test]
fn a_rejected_init_has_no_id_but_consumes_one() {
    let mut server = TestServer::new();
    server.ask(1, "/test;1;-1;x");
    server.event(1, TaskEvent::Rejected { reason: "busy" });
    server.told(&[(1, "/test;2;-1;busy")]);
    server.ask(1, "/test;1;-1;x");
    server.event(2, TaskEvent::Threw { message: "'goal'" });
    server.told(&[(1, "/test;3;-1;Controller threw exception: 'goal'")]);
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;2;1;Invalid ID '1'")]);
    server.accepted(3);
}

#[test]
fn abort_is_answered_when_the_task_has_ended() {
    let mut server = TestServer::new();
    server.accepted(1);
    assert_eq!(server.ask(2, "/test;3;1;"), Some(("abort", 1)));
    server.told(&[]);
    server.event(1, TaskEvent::Aborted { result: "at 40" });
    server.told(&[(2, "/test;4;1;True")]);
    server.ask(2, "/test;2;1;");
    server.told(&[(2, "/test;4;1;at 40")]);
}

#[test]
fn abort_of_a_task_that_completes_meanwhile_reports_completed() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ask(2, "/test;3;1;");
    server.event(1, TaskEvent::Completed { result: "40" });
    server.told(&[(2, "/test;5;1;40")]);
}

#[test]
fn a_slow_abort_is_answered_in_time_and_status_reports_the_final_state() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ask(2, "/test;3;1;");
    server.pass(Duration::from_millis(1499));
    server.told(&[]);
    server.pass(Duration::from_millis(1));
    server.told(&[(2, "/test;1;1;aborting")]);
    server.event(1, TaskEvent::Aborted { result: "late" });
    server.told(&[]);
    server.ask(2, "/test;2;1;");
    server.told(&[(2, "/test;4;1;late")]);
}

#[test]
fn a_refused_abort_is_reported_and_the_task_continues() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ask(2, "/test;3;1;");
    server.event(1, TaskEvent::AbortRejected);
    server.told(&[(2, "/test;1;1;False")]);
}

#[test]
fn abort_of_a_finished_task_keeps_its_result() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.event(1, TaskEvent::Completed { result: "hi" });
    assert_eq!(server.ask(2, "/test;3;1;"), None);
    server.told(&[(2, "/test;5;1;False")]);
    server.ask(2, "/test;2;1;");
    server.told(&[(2, "/test;5;1;hi")]);
}

#[test]
fn a_final_state_and_its_result_never_change() {
    let ends = [
        TaskEvent::Completed { result: "c" },
        TaskEvent::Failed { reason: "f" },
        TaskEvent::Aborted { result: "a" },
    ];
    for first in ends {
        let mut server = TestServer::new();
        server.accepted(1);
        server.event(1, first);
        server.ask(1, "/test;2;1;");
        let told = server.answers.clone();
        for later in ends.into_iter().chain([
            TaskEvent::Progress { text: "p" },
            TaskEvent::Accepted { reply: "r" },
            TaskEvent::Rejected { reason: "j" },
            TaskEvent::AbortRejected,
        ]) {
            server.event(1, later);
        }
        server.answers.clear();
        server.ask(1, "/test;2;1;");
        assert_eq!(server.answers, told);
    }
}

#[test]
fn an_undecided_init_is_answered_in_time_with_its_id() {
    let mut server = TestServer::new();
    server.ask(1, "/test;1;-1;x");
    server.pass(HOLD);
    server.told(&[(1, "/test;1;1;Initiated task '1', nobody has taken it yet")]);
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;0;1;None")]);
    server.event(1, TaskEvent::Rejected { reason: "no" });
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;2;1;no")]);
}

#[test]
fn a_full_table_drops_the_oldest_ended_task_and_never_a_running_one() {
    let mut server = TestServer::new();
    for id in 1..=3 {
        server.accepted(id);
    }
    server.ask(1, "/test;1;-1;x");
    server.told(&[(
        1,
        "/test;2;-1;too many tasks are running, wait for one to end",
    )]);
    server.event(2, TaskEvent::Completed { result: "2" });
    server.pass(Duration::from_secs(1));
    server.event(1, TaskEvent::Completed { result: "1" });
    server.accepted(4);
    server.ask(1, "/test;2;2;");
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;2;2;Invalid ID '2'"), (1, "/test;5;1;1")]);
}

#[test]
fn a_device_keeps_an_ended_task_until_its_slot_is_needed() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.event(1, TaskEvent::Completed { result: "done" });
    server.pass(Duration::from_secs(7200));
    assert_eq!(server.dispatcher.poll_timeout(), None);
    server.accepted(2);
    server.accepted(3);
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;5;1;done")]);
    server.accepted(4);
    server.ask(1, "/test;2;1;");
    server.told(&[(1, "/test;2;1;Invalid ID '1'")]);
}

#[test]
fn requests_are_answered_at_once_when_no_reply_can_be_held() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ask(1, "/test;1;-1;x");
    server.ask(2, "/test;1;-1;x");
    assert_eq!(server.ask(3, "/test;1;-1;x"), None);
    server.event(2, TaskEvent::Rejected { reason: "no" });
    server.ask(3, "/test;3;3;");
    assert_eq!(server.ask(4, "/test;3;1;"), Some(("abort", 1)));
    server.told(&[
        (3, "/test;2;-1;too many requests are waiting, try again"),
        (1, "/test;2;-1;no"),
        (4, "/test;1;1;aborting"),
    ]);
}

#[test]
fn a_result_that_does_not_fit_is_cut_at_a_character_boundary() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.event(
        1,
        TaskEvent::Completed {
            result: "fünfzehn zeichen und mehr",
        },
    );
    server.ask(1, "/test;2;1;");
    let (_, answer) = server.answers.pop().unwrap();
    assert_eq!(answer, "/test;5;1;fünfzehn zei…".to_string());
}

#[test]
fn an_abort_of_a_task_that_is_then_rejected_is_answered_too() {
    let mut server = TestServer::new();
    server.ask(1, "/test;1;-1;x");
    server.ask(2, "/test;3;1;");
    server.event(1, TaskEvent::Rejected { reason: "no" });
    server.told(&[(1, "/test;2;-1;no"), (2, "/test;2;1;no")]);
}

impl TestServer {
    /// A request of client 7 with this number, in our envelope.
    fn ours(&mut self, peer: u8, number: u64, request: &str) -> Option<(&'static str, u32)> {
        self.with_early_end(peer, number, false, request)
    }

    /// A request of client 7; `early_end` as in [`Envelope`].
    fn with_early_end(
        &mut self,
        peer: u8,
        number: u64,
        early_end: bool,
        request: &str,
    ) -> Option<(&'static str, u32)> {
        self.request_of(7, peer, number, early_end, request)
    }

    /// A request in our envelope.
    fn request_of(
        &mut self,
        client: u8,
        peer: u8,
        number: u64,
        early_end: bool,
        request: &str,
    ) -> Option<(&'static str, u32)> {
        let envelope = Envelope {
            client: ClientId([client; 16]),
            number,
            early_end,
        };
        self.handle(peer, Some(envelope), Body::One(request.as_bytes()))
    }
}

#[test]
fn status_of_our_clients_waits_for_the_final_state_and_others_do_not() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.ours(2, 1, "/test;2;1;wait 1000");
    server.ask(3, "/test;2;1;wait 1000");
    server.told(&[(3, "/test;1;1;None")]);
    server.event(1, TaskEvent::Progress { text: "half" });
    server.pass(Duration::from_millis(999));
    server.told(&[]);
    server.pass(Duration::from_millis(1));
    server.told(&[(2, "/test;1;1;half")]);
    server.ours(2, 2, "/test;2;1;wait 60000");
    server.pass(Duration::from_millis(1998));
    server.event(1, TaskEvent::Completed { result: "all" });
    server.told(&[(2, "/test;5;1;all")]);
    server.ours(2, 3, "/test;2;1;wait 1000");
    server.told(&[(2, "/test;5;1;all")]);
}

/// Both the table and the held replies or client records are full, and the table holds an ended task.
#[test]
fn a_rejected_init_drops_no_ended_task() {
    for held in [false, true] {
        let memory = Fixed::<u8, 1, 2, 16, 1>::new(["/test"]);
        let config = Config::new(TaskId::new(1).unwrap(), 4711);
        let mut dispatcher = Dispatcher::new(memory, config);
        let mut answers = Vec::new();
        let mut ask = |number: u64, enveloped: bool, body: &str| {
            let mut out = |_, reply: &Reply<'_>| answers.push(text(reply));
            let envelope = enveloped.then_some(Envelope {
                client: ClientId([number as u8; 16]),
                number,
                early_end: false,
            });
            let body = Body::One(body.as_bytes());
            let now = Instant::ZERO;
            let action = dispatcher.handle_request(now, 1, envelope, body, &mut out);
            if let Some(Action::Start { id, .. }) = action {
                let event = match id.get() {
                    1 => TaskEvent::Completed { result: "x" },
                    _ if held => return None,
                    _ => TaskEvent::Accepted { reply: "ok" },
                };
                dispatcher.handle_event(now, id, event, &mut out);
            }
            answers.pop()
        };
        assert!(ask(1, false, "/test;1;-1;x").is_some());
        let second = ask(2, !held, "/test;1;-1;x");
        assert_eq!(second.is_none(), held, "undecided");
        let refused = ask(3, true, "/test;1;-1;x").expect("an answer");
        let why = if held {
            "too many requests"
        } else {
            "too many clients"
        };
        assert!(refused.contains(why), "{refused}");
        assert_eq!(
            ask(4, false, "/test;2;1;").as_deref(),
            Some("/test;5;1;x"),
            "{why}"
        );
    }
}

#[test]
fn probe_describes_the_server() {
    let mut server = TestServer::new();
    server.accepted(1);
    server.accepted(2);
    server.event(1, TaskEvent::Completed { result: "" });
    server.ask(3, "$ztl;2;-1;probe");
    let version = crate::VERSION;
    server.told(&[(
        3,
        &std::format!(
            "$ztl;5;0;{{ztl: 1, version: '{version}', boot: 4711, scopes: {{\"/test\": {{}}, \"/other\": {{}}}}, running: {{2: \"/test\"}}}}"
        ),
    )]);
    for request in [
        "$ztl;1;-1;probe",
        "$ztl;2;-1;",
        "$ztl;x;-1;probe",
        "$ztl;2;-1;outcome 5",
    ] {
        assert_eq!(server.ask(3, request), None);
        let (_, answer) = server.answers.pop().unwrap();
        assert!(answer.starts_with("$ztl;2;0;Invalid request"), "{answer}");
    }
    for payload in ["outcome", "outcome x", "outcome -1"] {
        server.ours(3, 9, &std::format!("$ztl;2;-1;{payload}"));
        let (_, answer) = server.answers.pop().unwrap();
        assert!(answer.starts_with("$ztl;2;0;Invalid request"), "{answer}");
    }
}

#[test]
fn tasks_from_before_a_restart_are_known_and_their_ids_are_not_reused() {
    let mut server = TestServer::new();
    server.now = Instant::from_millis(7_200_000);
    let restore = |server: &mut TestServer, id, state, ended| {
        let mut task = Task::<_, heapless::String<16>>::new(Scope(1));
        task.state = state;
        crate::tasks::StoredText::set(&mut task.text, "before");
        task.ended = ended;
        server.dispatcher.restore(TaskId::new(id).unwrap(), task)
    };
    let half_an_hour_ago = Instant::from_millis(5_400_000);
    assert!(restore(&mut server, 7, State::Accepted, Instant::NEVER));
    assert!(restore(&mut server, 5, State::Completed, half_an_hour_ago));
    server.dispatcher.skip_to(TaskId::new(20).unwrap());
    server.accepted(21);
    assert!(
        !restore(&mut server, 30, State::Accepted, Instant::NEVER),
        "there is no room"
    );
    server.ask(2, "/other;2;7;");
    server.ask(2, "/other;2;5;");
    server.ask(2, "/test;2;7;");
    server.told(&[
        (2, "/other;1;7;before"),
        (2, "/other;5;5;before"),
        (2, "/test;2;7;Invalid ID '7'"),
    ]);
    assert_eq!(server.ask(2, "/other;3;7;"), Some(("abort", 7)));
    server.event(7, TaskEvent::Aborted { result: "here" });
    server.told(&[(2, "/other;4;7;True")]);
    // The task that ended first is dropped, and that was before the restart.
    server.accepted(31);
    server.ask(2, "/other;2;5;");
    server.ask(2, "/other;2;7;");
    server.told(&[(2, "/other;2;5;Invalid ID '5'"), (2, "/other;4;7;here")]);
}
