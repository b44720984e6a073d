//! Which messages of a robot do not reach a subscriber: those of hidden scopes, those without a subscription, and old states.

use std::path::Path;

use ztl_fleet::streams::{LONGEST_TOPIC, MOST_TOPICS};
use ztl_std::Subscriber;
use ztl_std::publish::Heard;
use ztl_tests::lab::{PATIENCE, Process, Scratch, Server, reserve_port, until, ztl};

use crate::streams::{DESK, Streaming, TURN, keys, next, next_within, number};
use crate::{Fleet, kill, python};

/// A robot whose file has these streams, and the port of its publisher.
fn robot(scratch: &Scratch, publish: u16, streams: &str) -> (Server, u16) {
    let file = scratch.path("robot.yaml");
    let text = format!(
        "port: 0\npublish: {publish}\nscopes: {{/test: {{nap: {{for: sleep}}}}, /test/priv: {{nap: {{for: sleep}}}}}}\nstreams: {streams}\n"
    );
    std::fs::write(&file, text).unwrap();
    let server = Server::start(ztl().arg("serve").arg(&file));
    let port = server.process.wait_for_port("Publishing ");
    (server, port)
}

/// A stream of numbers, and one in a hidden scope that notes when it runs.
fn streams(log: &Path) -> String {
    let numbers = "while sleep 0.02; do echo 7; done";
    format!(
        "{{/test: {{count: {{shell: '{numbers}', frame: json}}}}, /test/priv: {{count: {{shell: 'echo run >> {}; {numbers}', frame: json, when-watched: 1 s}}}}}}",
        log.display()
    )
}

fn is_of(heard: &Heard, topic: &str) -> bool {
    heard.topic == topic
}

/// Hears so many messages of the scope, and nothing of the hidden one below it.
#[track_caller]
fn hear_only_open(subscriber: &mut Subscriber, mut count: u32) {
    until("the scope that is allowed", PATIENCE, || {
        while let Some(heard) = next_within(subscriber, TURN) {
            assert!(is_of(&heard, "/arm/test/count"), "{}", heard.topic);
            count = count.saturating_sub(1);
        }
        (count == 0).then_some(())
    });
}

#[test]
fn who_may_use_a_scope_does_not_start_the_streams_of_a_hidden_one_below_it() {
    // The robot hides it from the endpoint's key.
    let scratch = Scratch::new();
    let [_, desk, anna, _] = keys(&scratch);
    let log = scratch.path("runs");
    let fleet = Streaming::fleet(scratch, DESK);
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let (server, at) = robot(&fleet.scratch, 0, &streams(&log));
    let publish = format!("publish: tcp://127.0.0.1:{at}\nfleet-key: arm.key_secret\n");
    let arm = format!("{publish}client-keys: /test=desk.key\n");
    let agent = fleet.join(&server, &arm);
    let mut subscriber =
        Subscriber::connect(&format!("tcp://127.0.0.1:{port}"), "/arm/test").unwrap();
    hear_only_open(&mut subscriber, 50);
    assert!(!log.exists(), "the hidden stream runs");
    drop(subscriber);
    kill(agent);

    // The endpoint hides it from a client.
    let arm = format!("{publish}client-keys: desk.key\n");
    let _agent = fleet.join(&server, &arm);
    let clients = "key: desk.key_secret\nclient-keys: [/arm/test=anna.key, desk.key]\npublish: 0\n";
    let more = format!("{DESK}{clients}");
    let endpoint = Fleet::start_endpoint(&fleet.scratch, &fleet.address, 0, &more);
    let port = endpoint.wait_for_port("Publishing ");
    let subscribe = |own: &ztl_std::keys::KeyPair| {
        let builder = Subscriber::builder().scope("/arm/test");
        let builder = builder.keys(own.clone(), desk.public());
        builder.connect(&format!("tcp://127.0.0.1:{port}")).unwrap()
    };
    let mut limited = subscribe(&anna);
    hear_only_open(&mut limited, 50);
    assert!(!log.exists(), "the hidden stream runs");
    // Who may use the whole robot hears both.
    let mut other = subscribe(&desk);
    until("the hidden stream", PATIENCE, || {
        let heard = next_within(&mut other, TURN)?;
        is_of(&heard, "/arm/test/priv/count").then_some(())
    });
    assert!(log.exists());
    hear_only_open(&mut limited, 50);
}

#[test]
fn who_subscribes_to_many_topics_of_a_scope_starts_no_stream_of_a_hidden_one() {
    let scratch = Scratch::new();
    let [_, desk, anna, _] = keys(&scratch);
    let log = scratch.path("runs");
    let clients = "key: desk.key_secret\nclient-keys: [/arm/test=anna.key, desk.key]\n";
    let fleet = Streaming::fleet(scratch, &format!("{DESK}{clients}"));
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let (server, at) = robot(&fleet.scratch, 0, &streams(&log));
    let arm = "fleet-key: arm.key_secret\nclient-keys: desk.key\n";
    let agent = fleet.start_agent(
        "arm",
        &server,
        &format!("publish: tcp://127.0.0.1:{at}\n{arm}"),
    );
    agent.wait_for("has joined");
    // None begins as another one. What is published comes last: once it is heard, all topics have arrived.
    let unused = (0..=MOST_TOPICS).map(|number| format!("/arm/test/unused-{number:03}"));
    let topics = unused.chain(["/arm/test/count".to_owned()]);
    let builder = Subscriber::builder().keys(anna, desk.public());
    let builder = topics.fold(builder, |builder, topic| builder.scope(&topic));
    let mut limited = builder.connect(&format!("tcp://127.0.0.1:{port}")).unwrap();
    hear_only_open(&mut limited, 50);
    assert!(!log.exists(), "the hidden stream runs");
}

#[test]
fn a_topic_with_more_hidden_scopes_than_an_agent_takes_leaves_the_others() {
    let scratch = Scratch::new();
    let [_, desk, anna, _] = keys(&scratch);
    let clients = "key: desk.key_secret\nclient-keys: [/arm/open=anna.key, /arm/test=anna.key]\n";
    let fleet = Streaming::fleet(scratch, &format!("{DESK}{clients}"));
    let port = fleet.endpoint.wait_for_port("Publishing ");
    // Each one is an exception of the topic /test/.
    let hidden = (0..LONGEST_TOPIC / 50).map(|number| format!("/test/{number:050}"));
    let nap = "{nap: {for: sleep}}";
    let scopes = ["/open".to_owned(), "/test".to_owned()]
        .into_iter()
        .chain(hidden);
    let scopes: Vec<String> = scopes.map(|scope| format!("{scope}: {nap}")).collect();
    let count = "{count: {shell: 'while sleep 0.02; do echo 7; done', frame: json}}";
    let file = fleet.scratch.path("robot.yaml");
    let text = format!(
        "port: 0\npublish: 0\nscopes: {{{}}}\nstreams: {{/open: {count}, /test: {count}}}\n",
        scopes.join(", ")
    );
    std::fs::write(&file, text).unwrap();
    let server = Server::start(ztl().arg("serve").arg(&file));
    let at = server.process.wait_for_port("Publishing ");
    let arm = format!(
        "publish: tcp://127.0.0.1:{at}\nfleet-key: arm.key_secret\nclient-keys: desk.key\n"
    );
    let agent = fleet.start_agent("arm", &server, &arm);
    agent.wait_for("has joined");
    let builder = Subscriber::builder().keys(anna, desk.public());
    let builder = builder.scope("/arm/test").scope("/arm/open");
    let mut limited = builder.connect(&format!("tcp://127.0.0.1:{port}")).unwrap();
    for _ in 0..10 {
        let heard = until("the other scope", PATIENCE, || {
            next_within(&mut limited, TURN)
        });
        assert_eq!(heard.topic, "/arm/open/count");
    }
}

#[test]
fn a_message_that_nobody_has_asked_for_is_dropped_at_the_endpoint() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let subscribe = |scope| Subscriber::connect(&format!("tcp://127.0.0.1:{port}"), scope).unwrap();
    let mut first = subscribe("/arm/test/pose");
    let robot = Process::start(&mut python("talkative.py", &[&fleet.address, "arm"]));
    // It has sent a state of another topic before, once.
    assert_eq!(next(&mut first, "/pose"), 1);
    robot.wait_for("sent what nobody asked for");
    let mut late = subscribe("/arm/test/secret");
    assert_eq!(
        next(&mut late, "/secret"),
        8,
        "not 7, which nobody asked for"
    );
}

#[test]
fn states_of_ztl_serve_arrive_as_states_and_do_not_outlive_it() {
    let fleet = Streaming::fleet(Scratch::new(), "robots: arm\n");
    let port = fleet.endpoint.wait_for_port("Publishing ");
    let subscribe =
        || Subscriber::connect(&format!("tcp://127.0.0.1:{port}"), "/arm/test").unwrap();
    let word = "word: {shell: 'while sleep 0.05; do echo 0; done', frame: json}";
    let with = |more: &str| format!("{{/test: {{{word}{more}}}}}");
    let at = reserve_port();
    let pose = ", pose: {shell: 'echo 1; exec sleep 1000', frame: json, latest: true}";
    let (server, _) = robot(&fleet.scratch, at, &with(pose));
    let publish = format!("publish: tcp://127.0.0.1:{at}\n");
    let _agent = fleet.join(&server, &publish);
    let mut early = subscribe();
    assert_eq!(next(&mut early, "/pose"), 1);
    // It was published once, and is a state for the endpoint, too.
    let mut late = subscribe();
    assert_eq!(next(&mut late, "/pose"), 1);

    kill(server.process);
    // One that has no such stream any more.
    let (_server, _) = robot(&fleet.scratch, at, &with(""));
    until("the new robot is heard", PATIENCE, || {
        let heard = next_within(&mut early, TURN)?;
        (number(&heard, "/word").is_some() && early.missed() > 0).then_some(())
    });
    let mut later = subscribe();
    for _ in 0..10 {
        let heard = until("the later one hears the robot", PATIENCE, || {
            next_within(&mut later, TURN)
        });
        assert_eq!(heard.topic, "/arm/test/word", "of the server before");
    }
}
