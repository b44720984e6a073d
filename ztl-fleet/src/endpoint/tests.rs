use ztl_core::envelope::ClientId;

use super::*;

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn info(boot: u32) -> RobotInfo {
    RobotInfo {
        ztl_fleet: 1,
        name: "arm".to_owned(),
        agent: "a".to_owned(),
        boot,
        clock_ms: 500,
        since: 0,
        held_ms: 0,
        groups: Vec::new(),
        streams: false,
        ready: true,
        problem: None,
        server: None,
        scopes: vec!["/lab".to_owned()],
    }
}

/// An endpoint that knows a robot.
fn endpoint() -> Endpoint {
    let mut endpoint = Endpoint::new(77);
    assert_eq!(endpoint.handle_alive("arm", "a").len(), 1);
    endpoint.handle_info(at(0), "arm", "a", info(7));
    endpoint
}

fn ask(
    endpoint: &mut Endpoint,
    now: u64,
    request: u64,
    number: Option<u64>,
    body: &str,
) -> Vec<EndpointEffect> {
    let envelope = number.map(|number| Envelope {
        client: ClientId([1; 16]),
        number,
        early_end: false,
    });
    let asked = ClientRequest {
        request,
        envelope,
        fresh: ClientId([9; 16]),
        body: Some(body.as_bytes()),
    };
    endpoint.handle_request(at(now), asked, |_| true)
}

/// The query, and what it asks.
#[track_caller]
fn asked(effects: &[EndpointEffect]) -> (u64, Ask) {
    match effects {
        [EndpointEffect::Ask { query, what, .. }] => (*query, what.clone()),
        other => panic!("{other:?}"),
    }
}

#[track_caller]
fn answered(effects: &[EndpointEffect]) -> String {
    match effects {
        [EndpointEffect::Answer { body, .. }] => String::from_utf8(body.clone()).unwrap(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_request_goes_to_the_robot_with_its_own_scope_and_back() {
    let mut endpoint = endpoint();
    let (query, what) = asked(&ask(&mut endpoint, 1000, 1, Some(3), "/arm/lab;1;-1;x;y"));
    let Ask::Request {
        rules: Some(rules),
        body,
        ..
    } = what
    else {
        panic!();
    };
    assert_eq!(body, b"/lab;1;-1;x;y");
    assert_eq!((rules.id.number, rules.boot, rules.until_ms), (3, 7, 3400));
    let answer = Verdict::Answer(b"/lab;1;42;on".to_vec());
    let told = endpoint.handle_verdict(at(1001), query, answer);
    assert_eq!(answered(&told), "/arm/lab;1;42;on");
    let told = ask(&mut endpoint, 1002, 2, Some(4), "$ztl;2;-1;outcome 3");
    assert_eq!(answered(&told), "$ztl;1;42;on");
}

#[test]
fn silence_of_a_robot_is_silence_and_its_outcome_is_asked_there() {
    let mut endpoint = endpoint();
    let (query, first) = asked(&ask(&mut endpoint, 0, 1, Some(3), "/arm/lab;1;-1;x"));
    endpoint.handle_no_reply(at(10), query);
    assert_eq!(endpoint.poll_timeout(), Some(at(110)));
    let (query, again) = asked(&endpoint.handle_timeout(at(110)));
    assert_eq!(first, again);
    let late = endpoint.handle_timeout(at(1900));
    assert_eq!(late, [EndpointEffect::Silence { request: 1 }]);
    assert_eq!(
        endpoint.handle_verdict(at(1901), query, Verdict::Unknown(String::new())),
        []
    );

    let (query, what) = asked(&ask(&mut endpoint, 2000, 2, Some(4), "$ztl;2;-1;outcome 3"));
    assert!(matches!(what, Ask::Outcome(rules) if rules.id.number == 3));
    let never = endpoint.handle_verdict(at(2001), query, Verdict::NotStarted(String::new()));
    assert_eq!(answered(&never), "$ztl;2;0;never seen since boot 77");
    let given_up = ask(&mut endpoint, 2002, 3, Some(3), "/arm/lab;1;-1;x");
    let told = "/arm/lab;2;-1;this INIT was given up by its client";
    assert_eq!(answered(&given_up), told);
}

#[test]
fn a_robot_that_is_away_starts_nothing_and_says_nothing_of_its_tasks() {
    let mut endpoint = endpoint();
    endpoint.handle_gone("arm", "a");
    let init = ask(&mut endpoint, 0, 1, None, "/arm/lab;1;-1;x");
    assert_eq!(
        answered(&init),
        "/arm/lab;2;-1;robot 'arm' is not connected"
    );
    let status = ask(&mut endpoint, 0, 2, None, "/arm/lab;2;42;");
    assert_eq!(status, [EndpointEffect::Silence { request: 2 }]);
    let other = ask(&mut endpoint, 0, 3, None, "/leg/lab;1;-1;x");
    let told = "/leg/lab;2;-1;No controller for scope: /leg/lab";
    assert_eq!(answered(&other), told);
}

#[test]
fn an_init_for_an_agent_that_was_restarted_is_sent_once_more() {
    let mut endpoint = endpoint();
    let (query, _) = asked(&ask(&mut endpoint, 0, 1, None, "/arm/lab;1;-1;x"));
    let stale = Verdict::Stale {
        boot: 8,
        clock_ms: 100,
    };
    let (_, what) = asked(&endpoint.handle_verdict(at(5), query, stale));
    let Ask::Request {
        rules: Some(rules), ..
    } = what
    else {
        panic!();
    };
    assert_eq!((rules.boot, rules.until_ms), (8, 1995));
    assert_eq!(rules.id.client, ClientId([9; 16]));
}

#[test]
fn a_second_agent_of_a_name_gets_nothing_while_the_first_is_there() {
    let mut endpoint = endpoint();
    let told = endpoint.handle_alive("arm", "b");
    assert!(matches!(told.as_slice(), [EndpointEffect::Rivals { .. }]));
    endpoint.handle_info(at(0), "arm", "b", info(9));
    let effects = ask(&mut endpoint, 0, 1, None, "/arm/lab;2;42;");
    assert!(matches!(&effects[..], [EndpointEffect::Ask { agent, .. }] if agent == "a"));
    let told = endpoint.handle_gone("arm", "a");
    assert!(matches!(&told[..], [EndpointEffect::AskInfo { agent, .. }] if agent == "b"));
}

#[test]
fn questions_collect_what_robots_say() {
    let mut endpoint = endpoint();
    endpoint.handle_alive("leg", "l");
    endpoint.handle_info(at(0), "leg", "l", info(5));
    let effects = ask(&mut endpoint, 0, 1, None, "$ztl;2;-1;tasks");
    assert_eq!(effects.len(), 2);
    let part = b"$ztl;5;0;{\"tasks\": [{\"id\": 4, \"scope\": \"/lab\"}], \"more\": 1}";
    let first = endpoint.handle_verdict(at(1), 1, Verdict::Answer(part.to_vec()));
    assert_eq!(first, []);
    // The other one does not answer.
    let told = answered(&endpoint.handle_timeout(at(1900)));
    let expected = r#"$ztl;5;0;{"elsewhere":0,"more":1,"tasks":[{"id":4,"scope":"/arm/lab"}]}"#;
    assert_eq!(told, expected);

    let probe = answered(&ask(&mut endpoint, 2000, 2, None, "$ztl;2;-1;probe"));
    assert!(
        probe.contains(r#"scopes: {"/arm/lab": {}, "/leg/lab": {}}"#),
        "{probe}"
    );

    let (query, _) = asked(&ask(&mut endpoint, 2000, 3, None, "$ztl;2;-1;describe"));
    let part = br#"$ztl;5;0;{"components": [{"scope": "/lab"}], "next": 7}"#;
    let told = answered(&endpoint.handle_verdict(at(2001), query, Verdict::Answer(part.to_vec())));
    assert!(
        told.ends_with(r#"{"components":[{"scope":"/arm/lab"}],"next":7}"#),
        "{told}"
    );
    let (query, _) = asked(&ask(&mut endpoint, 2000, 4, None, "$ztl;2;-1;describe ;7"));
    let part = br#"$ztl;5;0;{"components": []}"#;
    let told = answered(&endpoint.handle_verdict(at(2001), query, Verdict::Answer(part.to_vec())));
    assert!(
        told.ends_with(r#"{"components":[],"next":1000000}"#),
        "{told}"
    );
}

#[test]
fn a_status_is_held_at_the_robot_and_its_answer_has_time_to_arrive() {
    let mut endpoint = endpoint();
    for (told, passed) in [
        ("wait 1999", "wait 1500"),
        ("wait 70", "wait 70"),
        ("wait x", "wait x"),
        ("status update", "status update"),
    ] {
        let body = format!("/arm/lab;2;42;{told}");
        let (_, what) = asked(&ask(&mut endpoint, 0, 1, Some(3), &body));
        let Ask::Request { body, .. } = what else {
            panic!();
        };
        assert_eq!(body, format!("/lab;2;42;{passed}").into_bytes());
    }
}

#[test]
fn a_question_that_was_too_late_is_asked_again_with_the_robots_clock() {
    let mut endpoint = endpoint();
    let (mut query, first) = asked(&ask(&mut endpoint, 0, 1, None, "/arm/lab;3;42;"));
    for clock_ms in 0..u64::from(STALE) {
        let stale = Verdict::Stale { boot: 8, clock_ms };
        let (next, again) = asked(&endpoint.handle_verdict(at(5), query, stale));
        assert_eq!(again, first);
        assert_eq!(endpoint.clock(at(5), "arm"), (8, clock_ms));
        assert_eq!(endpoint.request_of(next), Some(1));
        query = next;
    }
    let stale = Verdict::Stale {
        boot: 8,
        clock_ms: 9,
    };
    let told = endpoint.handle_verdict(at(5), query, stale);
    assert_eq!(told, [EndpointEffect::Silence { request: 1 }]);
}

#[test]
fn a_flood_of_names_and_agents_is_bounded_and_keeps_who_is_there() {
    let mut endpoint = endpoint();
    for number in 0..20_000 {
        endpoint.handle_alive(&format!("robot-{number}"), "a");
        endpoint.handle_alive("arm", &format!("rival-{number}"));
    }
    assert_eq!(endpoint.robots().count(), 10_000);
    let answer = ask(&mut endpoint, 0, 1, None, "/arm/lab;2;42;");
    assert!(matches!(&answer[..], [EndpointEffect::Ask { agent, .. }] if agent == "a"));
    // Those that leave make room.
    endpoint.handle_gone("robot-7", "a");
    assert_eq!(endpoint.handle_alive("leg", "l").len(), 1);
    let promoted = (0..100).filter(|number| {
        let served = format!("rival-{number}");
        let agent = if *number == 0 { "a" } else { &served };
        !endpoint.handle_gone("arm", agent).is_empty()
    });
    assert!(promoted.count() <= 16);
}

#[test]
fn a_repeated_init_keeps_its_rules_and_is_not_refused_when_its_robot_is_gone() {
    let mut endpoint = endpoint();
    let (query, first) = asked(&ask(&mut endpoint, 0, 1, Some(3), "/arm/lab;1;-1;x"));
    endpoint.handle_info(at(1), "arm", "a", info(8));
    let (_, again) = asked(&ask(&mut endpoint, 2, 2, Some(3), "/arm/lab;1;-1;x"));
    assert_eq!(again, first);
    endpoint.handle_no_reply(at(3), query);
    endpoint.handle_gone("arm", "a");
    let gone = ask(&mut endpoint, 4, 3, Some(3), "/arm/lab;1;-1;x");
    assert_eq!(gone, [EndpointEffect::Silence { request: 3 }]);
    // One that was refused stays refused.
    let refused = ask(&mut endpoint, 5, 4, Some(4), "/arm/lab;1;-1;x");
    assert!(answered(&refused).contains("not connected"));
    endpoint.handle_alive("arm", "a");
    let again = ask(&mut endpoint, 6, 5, Some(4), "/arm/lab;1;-1;x");
    assert!(answered(&again).contains("given up"));
    // A robot that is not known may have tasks.
    let unknown = ask(&mut endpoint, 7, 6, None, "/leg/lab;2;42;");
    assert_eq!(unknown, [EndpointEffect::Silence { request: 6 }]);
}

#[test]
fn who_may_use_one_scope_is_told_of_others_only_how_many_tasks_run() {
    let mut endpoint = endpoint();
    let scopes = vec!["/lab".to_owned(), "/priv".to_owned()];
    let robot = RobotInfo { scopes, ..info(5) };
    endpoint.handle_info(at(0), "arm", "a", robot);
    let mut told = |request, payload: &str, says: &str| {
        let body = format!("$ztl;2;-1;{payload}");
        let client_request = ClientRequest {
            request,
            envelope: None,
            fresh: ClientId([9; 16]),
            body: Some(body.as_bytes()),
        };
        let only_lab = |scope: &str| scope == "/arm/lab";
        let effects = endpoint.handle_request(at(0), client_request, only_lab);
        if let [EndpointEffect::Answer { .. }] = &effects[..] {
            return answered(&effects);
        }
        let verdict = Verdict::Answer(format!("$ztl;5;0;{says}").into_bytes());
        answered(&endpoint.handle_verdict(at(1), asked(&effects).0, verdict))
    };
    let tasks = format!(
        r#"{{"tasks":[{{"id":4,"scope":"/priv","state":1}},{{"id":5,"scope":"/lab","state":1}},{{"id":6,"scope":"/priv","state":4}}],"more":{},"elsewhere":{}}}"#,
        u64::MAX,
        2
    );
    let max = u64::MAX;
    assert_eq!(
        told(1, "tasks", &tasks),
        format!(
            r#"$ztl;5;0;{{"elsewhere":3,"more":{max},"tasks":[{{"id":5,"scope":"/arm/lab","state":1}}]}}"#
        )
    );
    let components = r#"{"components":[{"scope":"/priv"},{"scope":"/lab"}]}"#;
    let only_lab = r#"$ztl;5;0;{"components":[{"scope":"/arm/lab"}]}"#;
    assert_eq!(told(2, "describe", components), only_lab);
    let none = r#"$ztl;5;0;{"components":[]}"#;
    assert_eq!(told(3, "describe /arm/priv", components), none);
    let devices = r#"{"/priv":{"a":1},"/lab":{"b":2}}"#;
    let only_lab = r#"$ztl;5;0;{"/arm/lab":{"b":2}}"#;
    assert_eq!(told(4, "devices", devices), only_lab);
}

#[test]
fn a_repeated_number_of_another_init_leaves_what_became_of_the_first_one() {
    let started = "/arm/lab;1;42;on";
    let another = "/arm/lab;2;-1;another INIT has this number";
    let mut endpoint = endpoint();
    let (query, _) = asked(&ask(&mut endpoint, 0, 1, Some(2), "/arm/lab;1;-1;x"));
    let other = ask(&mut endpoint, 1, 2, Some(2), "/arm/lab;1;-1;y");
    assert_eq!(answered(&other), another);
    let told = endpoint.handle_verdict(at(2), query, Verdict::Answer(b"/lab;1;42;on".to_vec()));
    assert_eq!(answered(&told), started);
    let other = ask(&mut endpoint, 3, 3, Some(2), "/arm/lab;1;-1;y");
    assert_eq!(answered(&other), another);
    let told = ask(&mut endpoint, 4, 4, Some(3), "$ztl;2;-1;outcome 2");
    assert_eq!(answered(&told), "$ztl;1;42;on");

    // An endpoint that was restarted does not know the first one, but its robot does.
    let mut endpoint = self::endpoint();
    let (query, _) = asked(&ask(&mut endpoint, 0, 1, Some(2), "/arm/lab;1;-1;y"));
    let verdict = Verdict::NotStarted("another INIT has this number".to_owned());
    let told = endpoint.handle_verdict(at(1), query, verdict);
    assert_eq!(answered(&told), another);
    let outcome = ask(&mut endpoint, 2, 2, Some(3), "$ztl;2;-1;outcome 2");
    assert!(matches!(asked(&outcome).1, Ask::Outcome(_)));
    // The first one, repeated, is not rejected: its task runs.
    let (query, _) = asked(&ask(&mut endpoint, 3, 3, Some(2), "/arm/lab;1;-1;x"));
    let told = endpoint.handle_verdict(at(4), query, Verdict::Answer(b"/lab;1;42;on".to_vec()));
    assert_eq!(answered(&told), started);
}

#[test]
fn an_init_is_refused_while_two_machines_answer_and_one_for_a_robot_of_the_file_says_that_it_is_away()
 {
    let mut endpoint = endpoint();
    endpoint.expect(["leg".to_owned()]);
    endpoint.handle_doubt("arm", true);
    let refused = ask(&mut endpoint, 0, 1, Some(2), "/arm/lab;1;-1;x");
    let told = "/arm/lab;2;-1;two machines answer as robot 'arm', so neither gets a task";
    assert_eq!(answered(&refused), told);
    let status = ask(&mut endpoint, 0, 2, None, "/arm/lab;2;42;");
    assert_eq!(status, [EndpointEffect::Silence { request: 2 }]);
    endpoint.handle_doubt("arm", false);
    asked(&ask(&mut endpoint, 1, 3, Some(3), "/arm/lab;1;-1;x"));
    let away = ask(&mut endpoint, 1, 4, None, "/leg/lab;1;-1;x");
    assert_eq!(
        answered(&away),
        "/leg/lab;2;-1;robot 'leg' is not connected"
    );
}

#[test]
fn while_two_machines_answer_each_is_told_an_abort_once_and_the_client_nothing() {
    let mut endpoint = endpoint();
    endpoint.handle_doubt("arm", true);
    let (each, abort) = asked(&ask(&mut endpoint, 0, 1, None, "/arm/lab;3;42;"));
    let stale = |boot: u32| Verdict::Stale {
        boot,
        clock_ms: 1000,
    };
    let answer = Verdict::Answer(b"/lab;4;42;True".to_vec());
    assert_eq!(endpoint.handle_verdict(at(1), each, answer.clone()), []);
    let (one, again) = asked(&endpoint.handle_verdict(at(2), each, stale(8)));
    assert_eq!((again, endpoint.clock(at(2), "arm")), (abort, (8, 1000)));
    assert_eq!(endpoint.handle_verdict(at(2), each, stale(8)), []);
    assert_eq!(endpoint.handle_verdict(at(3), one, stale(7)), []);
    assert_eq!(endpoint.handle_verdict(at(3), one, answer.clone()), []);
    // Anybody with the key could answer under many names.
    for boot in 9..12 {
        asked(&endpoint.handle_verdict(at(4), each, stale(boot)));
    }
    assert_eq!(endpoint.handle_verdict(at(4), each, stale(12)), []);
    let silence = EndpointEffect::Silence { request: 1 };
    assert_eq!(endpoint.handle_no_reply(at(5), each), [silence]);
    assert_eq!(endpoint.handle_verdict(at(6), each, answer), []);
}

#[test]
fn an_abort_is_repeated_while_only_one_of_two_machines_answers() {
    let mut endpoint = endpoint();
    endpoint.handle_doubt("arm", true);
    let (each, abort) = asked(&ask(&mut endpoint, 0, 1, None, "/arm/lab;3;42;"));
    let answer = Verdict::Answer(b"/lab;4;42;True".to_vec());
    assert_eq!(endpoint.handle_verdict(at(1), each, answer.clone()), []);
    assert_eq!(endpoint.handle_no_reply(at(2), each), []);
    let (again, what) = asked(&endpoint.handle_timeout(at(102)));
    assert_eq!(what, abort);
    for _ in 0..2 {
        assert_eq!(endpoint.handle_verdict(at(103), again, answer.clone()), []);
    }
    let silence = EndpointEffect::Silence { request: 1 };
    assert_eq!(endpoint.handle_no_reply(at(104), again), [silence]);
}

#[test]
fn an_init_that_waited_for_its_turn_is_valid_no_longer() {
    let mut endpoint = endpoint();
    endpoint.handle_info(at(1700), "arm", "a", info(7));
    let (_, what) = asked(&ask(&mut endpoint, 1600, 1, None, "/arm/lab;1;-1;x"));
    let Ask::Request {
        rules: Some(rules), ..
    } = what
    else {
        panic!();
    };
    // The agent's clock showed 500 ms at 1700.
    assert_eq!((rules.id.number, rules.until_ms), (0, 400 + 1900));
}

#[test]
fn digits_that_are_not_ascii_are_refused() {
    let mut endpoint = endpoint();
    for odd in ["/arm/lab;\u{ff11};-1;x", "/arm/lab;3;\u{0664}2;"] {
        let told = answered(&ask(&mut endpoint, 0, 1, None, odd));
        assert_eq!(told, "/arm/lab;2;-1;Invalid request");
    }
}

#[test]
fn a_robot_speaks_for_no_other_one_and_hides_none() {
    let mut endpoint = endpoint();
    let scopes = vec!["-1/lab".to_owned(), "/lab".to_owned()];
    let server = "{ztl: 1, version: '1', boot: 3, scopes: {/lab: {led: [on]}, -1/lab: {x: [y]}}}";
    let server = Some(server.to_owned());
    let robot = RobotInfo {
        scopes,
        server,
        ..info(7)
    };
    endpoint.handle_info(at(0), "arm", "a", robot);
    endpoint.handle_alive("arm-1", "b");
    let second = RobotInfo {
        name: "arm-1".to_owned(),
        ..info(8)
    };
    endpoint.handle_info(at(0), "arm-1", "b", second);
    let probe = answered(&ask(&mut endpoint, 0, 1, None, "$ztl;2;-1;probe"));
    let told = r#"scopes: {"/arm/lab": {"led":["on"]}, "/arm-1/lab": {}}"#;
    assert!(probe.contains(told), "{probe}");
    ask(&mut endpoint, 0, 2, None, "$ztl;2;-1;tasks");
    let part = r#"$ztl;5;0;{"tasks": [{"id": 4, "scope": "-1/lab", "state": 1}]}"#;
    endpoint.handle_verdict(at(1), 1, Verdict::Answer(part.into()));
    let told = answered(&endpoint.handle_timeout(at(1900)));
    assert_eq!(told, r#"$ztl;5;0;{"elsewhere":1,"more":0,"tasks":[]}"#);
    for (from, next) in [
        ("", "999999"),
        ("999999", "999999"),
        ("7", "7"),
        ("7", "1000000000"),
    ] {
        let question = format!("$ztl;2;-1;describe ;{from}");
        let question = question.trim_end_matches(';');
        let (query, _) = asked(&ask(&mut endpoint, 2000, 3, None, question));
        let part = format!(r#"$ztl;5;0;{{"components": [], "next": {next}}}"#);
        let told = endpoint.handle_verdict(at(2001), query, Verdict::Answer(part.into()));
        let expected = match from {
            "" => "\"next\":999999}",
            _ => "\"next\":1000000}",
        };
        assert!(answered(&told).ends_with(expected), "{from} {next}");
    }
}
