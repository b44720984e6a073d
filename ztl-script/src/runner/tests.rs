//! A runner with connections that a test holds back.

use super::*;
use crate::Defaults;
use crate::server::Acceptance;

/// A server that accepts every INIT that it gets, once the test lets it.
struct Gated {
    reached: Sender<String>,
    gate: Arc<std::sync::Mutex<Receiver<()>>>,
    sent: Sender<String>,
}

impl Connection for Gated {
    fn request(&mut self, request: &ServerRequest, may_start: &dyn Fn() -> bool) -> ServerAnswer {
        let listed = Some((1, Vec::new()));
        match request {
            ServerRequest::Init { component, .. } => {
                self.reached.send(component.clone()).unwrap();
                self.gate.lock().unwrap().recv().unwrap();
                if !may_start() {
                    return ServerAnswer::Withdrawn;
                }
                self.sent.send(component.clone()).unwrap();
                ServerAnswer::Rejected {
                    id: 1_i64.into(),
                    text: "no".to_owned(),
                }
            }
            ServerRequest::Tasks => ServerAnswer::Tasks {
                listed,
                gaps: Vec::new(),
            },
            _ => ServerAnswer::Unclear {
                text: "not expected".to_owned(),
            },
        }
    }

    fn offers(&mut self) -> Option<ztl_std::Offers> {
        None
    }

    fn would_accept(&mut self, _: &str, _: &str, _: &str) -> Acceptance {
        Acceptance::Unknown
    }
}

/// Plays a script whose servers hold each INIT; returns what reaches them, what lets it go on, and what was sent.
fn gated(file: &[u8]) -> (Runner, Receiver<String>, Sender<()>, Receiver<String>) {
    let script = Script::read("f", file, Defaults::default()).unwrap();
    let (reached, at_gate) = mpsc::channel();
    let (open, gate) = mpsc::channel();
    let (sent, arrived) = mpsc::channel();
    let gate = Arc::new(std::sync::Mutex::new(gate));
    let connect: Connect = Box::new(move |_| {
        let (reached, gate, sent) = (reached.clone(), Arc::clone(&gate), sent.clone());
        Ok(Box::new(Gated {
            reached,
            gate,
            sent,
        }))
    });
    let options = PlayOptions {
        remotes: ["r".to_owned()].into(),
        ..PlayOptions::default()
    };
    let mut runner = Runner::new(script.into(), options, connect);
    runner.begin();
    (runner, at_gate, open, arrived)
}

/// Takes events until a question is asked.
fn until_asked(runner: &mut Runner) -> Option<Question> {
    loop {
        if let Some(StampedEvent {
            event: RunEvent::Asked { question, .. },
            ..
        }) = runner.next(Duration::from_secs(60))
        {
            return Some(question);
        }
    }
}

#[test]
fn nothing_that_was_decided_before_a_stop_is_sent_after_it() {
    let file = b"one: {a: {r: {x: 1}}, b: {r: {y: 1}}}";
    let (mut runner, at_gate, open, arrived) = gated(file);
    let scene = Some(Question::Scene { scene: 0 });
    assert_eq!(until_asked(&mut runner), scene);
    let before = runner.handle().seen();
    assert!(runner.has_obeyed(before));
    assert!(runner.decide(RunCommand::Start, scene));
    let wait = Duration::from_secs(60);
    assert_eq!(at_gate.recv_timeout(wait).as_deref(), Ok("x"));
    // The runner has not heard of it, and the request is on its way.
    runner.handle().stop_all();
    assert!(!runner.has_obeyed(before) && !runner.has_obeyed(runner.handle().seen()));
    open.send(()).unwrap();
    assert_eq!(until_asked(&mut runner), scene);
    assert!(arrived.try_recv().is_err(), "it was sent after the stop");
    assert!(at_gate.try_recv().is_err(), "a step began after the stop");
    // Who decided before the stop has not seen it; who decides now has.
    assert!(!runner.has_obeyed(before));
    assert!(runner.has_obeyed(runner.handle().seen()));
    assert!(runner.decide(RunCommand::Start, scene));
    open.send(()).unwrap();
    assert_eq!(arrived.recv_timeout(wait).as_deref(), Ok("x"));
}

#[test]
fn what_is_stopped_before_it_is_sent_is_not_sent() {
    for stop in [RunCommand::StopScene, RunCommand::StopAll, RunCommand::Stop] {
        let (mut runner, at_gate, open, arrived) =
            gated(b"one: {a: {r: {x: 1}}}\ncues: {wave: {r: {c: 1}}}");
        let scene = until_asked(&mut runner);
        assert!(runner.decide(RunCommand::Start, scene));
        let wait = Duration::from_secs(60);
        assert_eq!(at_gate.recv_timeout(wait).as_deref(), Ok("x"));
        assert_eq!(runner.cue(0), Ok(()));
        assert_eq!(at_gate.recv_timeout(wait).as_deref(), Ok("c"));
        assert!(runner.decide(stop, None));
        open.send(()).unwrap();
        open.send(()).unwrap();
        // Only the scene is stopped, not the cue beside it.
        if stop == RunCommand::StopScene {
            assert_eq!(arrived.recv_timeout(wait).as_deref(), Ok("c"));
        }
        let ended =
            |event: &RunEvent| matches!(event, RunEvent::Asked { .. } | RunEvent::RunEnded { .. });
        while !runner
            .next(wait)
            .is_some_and(|stamped| ended(&stamped.event))
        {}
        assert_eq!(arrived.try_recv().ok(), None, "after {stop:?}");
    }
}

/// A connection that gives its number as an id, and tells who is asked for which id.
struct Numbered {
    number: RemoteId,
    asked: Sender<(RemoteId, RemoteId)>,
}

impl Connection for Numbered {
    fn request(&mut self, request: &ServerRequest, _: &dyn Fn() -> bool) -> ServerAnswer {
        let text = String::new();
        if let ServerRequest::Status { id, .. } = request {
            let asked = (self.number.clone(), id.clone());
            self.asked.send(asked).unwrap();
            return ServerAnswer::Unclear { text };
        }
        ServerAnswer::Started {
            id: self.number.clone(),
            text,
            server: crate::server::Server::Original,
        }
    }

    fn offers(&mut self) -> Option<ztl_std::Offers> {
        None
    }

    fn would_accept(&mut self, _: &str, _: &str, _: &str) -> Acceptance {
        Acceptance::Unknown
    }
}

#[test]
fn the_connection_that_started_a_task_asks_for_it() {
    let script = Script::read("f", b"one: {a: {r: {x: 1}}}", Defaults::default()).unwrap();
    let (asked, heard) = mpsc::channel();
    let mut count = 0_i64;
    let connect: Connect = Box::new(move |_| {
        count += 1;
        Ok(Box::new(Numbered {
            number: count.into(),
            asked: asked.clone(),
        }))
    });
    let mut runner = Runner::new(script.into(), PlayOptions::default(), connect);
    let mut send = |bodies: &[ServerRequest]| {
        for body in bodies {
            let (number, remote) = (RequestNumber(1), "r".to_owned());
            let body = body.clone();
            let request = Request {
                number,
                remote,
                body,
            };
            runner.send(request).unwrap();
        }
        while runner.idle.get("r").map_or(0, Vec::len) < 2 {
            runner.next(Duration::from_millis(1));
        }
    };
    let [handler, component, goal] = ["h", "c", "g"].map(str::to_owned);
    let init = ServerRequest::Init {
        handler,
        component,
        goal,
    };
    send(&[init.clone(), init]);
    for id in [1, 2, 1, 1, 2, 2] {
        let id = RemoteId::from(id);
        send(&[ServerRequest::Status {
            id: id.clone(),
            text: String::new(),
            hold: Duration::ZERO,
        }]);
        assert_eq!(heard.try_recv(), Ok((id.clone(), id)));
    }
}

#[test]
fn a_flood_of_stops_is_one_stop_and_all_of_them_are_obeyed() {
    let (mut runner, ..) = gated(b"one: {a: {r: {x: 1}}}");
    until_asked(&mut runner);
    let handle = runner.handle();
    let mut decisions = 0;
    for _ in 0..200 {
        handle.stop_all();
        while !runner.has_obeyed(handle.seen()) || runner.player.question().is_none() {
            let event = runner.next(Duration::from_millis(1));
            let event = event.map(|event| event.event);
            decisions += usize::from(matches!(event, Some(RunEvent::Decided { .. })));
        }
    }
    assert!((1..100).contains(&decisions), "{decisions}");
}

#[test]
fn a_decision_answers_only_the_question_that_the_operator_saw() {
    let file = b"one: {a(on_failure=ask): {nobody: {x: 1}}}\ntwo: {b: {nobody: {x: 1}}}";
    let script = Script::read("f", file, Defaults::default()).unwrap();
    let mut runner = Runner::new(
        script.into(),
        PlayOptions::default(),
        Box::new(|_| Err("nobody is there".to_owned())),
    );
    runner.begin();
    let scene = Some(Question::Scene { scene: 0 });
    assert!(runner.decide(RunCommand::Start, scene));
    // It could not be started, and the operator has not seen that yet.
    let step = Some(Question::Step { scene: 0, step: 0 });
    assert_eq!(runner.player.question(), step);
    assert!(!runner.decide(RunCommand::Skip, scene));
    assert_eq!(runner.player.question(), step);
    assert!(runner.decide(RunCommand::Skip, step));
    assert_eq!(runner.player.question(), Some(Question::Scene { scene: 1 }));
    assert!(runner.decide(RunCommand::Stop, step), "at any time");
}
