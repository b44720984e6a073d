//! Publishers and subscribers of this crate and of libzmq.

use std::time::{Duration, Instant};

use ztl_tests::lab::{PATIENCE, until};

use super::*;
use crate::keys::KeyPair;
use crate::{Access, ExecutableTask, RemoteTask, TaskContext, TaskController, TaskError};
use crate::{TaskRequest, TaskServer};

const LIMIT: Duration = Duration::from_secs(20);

fn publisher() -> Publisher {
    Publisher::bind("tcp://127.0.0.1:*", "/lab").unwrap()
}

/// Publishes until the subscriber hears it; returns the topics before.
#[track_caller]
fn until_heard(publisher: &Publisher, subscriber: &mut Subscriber, path: &str) -> Vec<String> {
    let end = Instant::now() + LIMIT;
    let mut topics = Vec::new();
    while Instant::now() < end {
        publisher.publish_bytes(path, b"N.", false);
        while let Some(heard) = subscriber.next_within(Duration::from_millis(10)).unwrap() {
            if heard.topic == format!("/lab{path}") {
                return topics;
            }
            topics.push(heard.topic);
        }
    }
    panic!("{path} is not heard");
}

#[test]
fn a_subscriber_hears_its_scope_and_what_is_below_it() {
    let publisher = publisher();
    let mut subscriber = Subscriber::connect(publisher.endpoint(), "/lab/arm").unwrap();
    until_heard(&publisher, &mut subscriber, "/arm/begin");
    for path in ["/arm2", "/arm/left", "/ar", "/arm", "/arm2/left", ""] {
        assert!(publisher.publish_bytes(path, b"N.", false));
    }
    let mut heard = until_heard(&publisher, &mut subscriber, "/arm/done");
    heard.retain(|topic| topic != "/lab/arm/begin");
    assert_eq!(heard, ["/lab/arm/left", "/lab/arm"]);
    assert_eq!((subscriber.missed(), subscriber.damaged()), (0, 0));
}

#[test]
fn who_subscribes_late_gets_the_newest_state_of_each_topic() {
    let publisher = publisher();
    let mut early = Subscriber::connect(publisher.endpoint(), "").unwrap();
    for number in 0..3u8 {
        publisher.publish_bytes("/battery", &[number], true);
        publisher.publish_bytes("/event", &[number], false);
    }
    publisher.publish_bytes("/door", b"open", true);
    // The thread has taken all of these.
    until_heard(&publisher, &mut early, "/now");
    let mut late = Subscriber::connect(publisher.endpoint(), "/lab").unwrap();
    let mut heard = || late.next_within(LIMIT).unwrap().unwrap();
    let states = [heard(), heard()].map(|heard| (heard.topic, heard.body));
    assert_eq!(states[0], ("/lab/battery".to_owned(), vec![2]));
    assert_eq!(states[1], ("/lab/door".to_owned(), b"open".to_vec()));
}

#[test]
fn a_slow_subscriber_learns_how_many_messages_it_missed() {
    let publisher = publisher();
    let mut slow = Subscriber::connect(publisher.endpoint(), "").unwrap();
    let mut quick = Subscriber::connect(publisher.endpoint(), "/lab/image").unwrap();
    until_heard(&publisher, &mut slow, "/begin");
    until_heard(&publisher, &mut quick, "/image/begin");
    const MESSAGES: u32 = 300;
    let mut numbers = Vec::new();
    for number in 0..MESSAGES {
        let image = [&number.to_be_bytes()[..], &[7; 200_000]].concat();
        assert!(publisher.publish_bytes("/image", &image, false), "{number}");
        // It keeps up.
        while numbers.last() != Some(&number) {
            let heard = quick.next_within(LIMIT).unwrap().unwrap();
            if heard.topic == "/lab/image" {
                numbers.push(u32::from_be_bytes(heard.body[..4].try_into().unwrap()));
            }
        }
    }
    assert_eq!(numbers, (0..MESSAGES).collect::<Vec<_>>());
    assert_eq!(quick.missed(), 0);
    let heard = until_heard(&publisher, &mut slow, "/end");
    let heard = heard.iter().filter(|topic| *topic == "/lab/image").count();
    until_heard(&publisher, &mut slow, "/told");
    let missed = usize::try_from(slow.missed()).unwrap();
    assert!(missed > 0);
    assert_eq!(heard + missed, MESSAGES as usize);
    assert_eq!(publisher.missed(), slow.missed());
}

#[test]
fn what_waits_for_a_slow_subscriber_arrives_without_another_message() {
    const MESSAGES: u8 = 70;
    let publisher = publisher();
    let [mut slow, mut quick] =
        [(); 2].map(|()| Subscriber::connect(publisher.endpoint(), "/lab").unwrap());
    until_heard(&publisher, &mut slow, "/begin");
    until_heard(&publisher, &mut quick, "/begin");
    // More than the system takes, and less than the publisher keeps.
    for number in 0..MESSAGES {
        assert!(publisher.publish_bytes("/image", &[number; 100_000], false));
    }
    for subscriber in [&mut quick, &mut slow] {
        let mut numbers = Vec::new();
        while numbers.len() < MESSAGES.into() {
            let heard = subscriber.next_within(LIMIT).unwrap().expect("a message");
            if heard.topic == "/lab/image" {
                numbers.push(heard.body[0]);
            }
        }
        assert_eq!(numbers, (0..MESSAGES).collect::<Vec<_>>());
    }
}

#[test]
fn what_was_missed_is_told_without_holding_up_a_long_message_behind_it() {
    const MESSAGES: u8 = 70;
    let publisher = publisher();
    let mut quick = Subscriber::connect(publisher.endpoint(), "/lab").unwrap();
    until_heard(&publisher, &mut quick, "/begin");
    // It depends on how much the system takes at once.
    for _ in 0..10 {
        let mut slow = Subscriber::connect(publisher.endpoint(), "/lab").unwrap();
        until_heard(&publisher, &mut slow, "/begin");
        for number in 0..MESSAGES {
            assert!(publisher.publish_bytes("/image", &[number; 700_000], false));
            while quick.next_within(LIMIT).unwrap().unwrap().body[0] != number {}
        }
        let mut last = 0;
        while last != MESSAGES - 1 {
            // Its slowness is what is tested.
            std::thread::sleep(Duration::from_millis(5));
            let heard = slow.next_within(LIMIT).unwrap().expect("a message");
            if heard.topic == "/lab/image" {
                last = heard.body[0];
            }
        }
        assert!(slow.missed() > 0);
    }
}

#[test]
fn a_slow_subscriber_gets_a_state_that_was_dropped_when_it_has_caught_up() {
    let publisher = publisher();
    let mut slow = Subscriber::connect(publisher.endpoint(), "").unwrap();
    let mut quick = Subscriber::connect(publisher.endpoint(), "/lab/image").unwrap();
    until_heard(&publisher, &mut slow, "/begin");
    until_heard(&publisher, &mut quick, "/image/begin");
    let mut flood = |begins| {
        for number in begins..begins + 100u8 {
            let image = [&[number][..], &[7; 200_000]].concat();
            assert!(publisher.publish_bytes("/image", &image, false));
            while quick.next_within(LIMIT).unwrap().unwrap().body[0] != number {}
        }
    };
    // The first images fill its connection, so that the state waits behind them, and is dropped before they end. Seldom, the
    // system takes more just when the state is the oldest one that waits: then it comes before them, and was not dropped.
    let was_dropped = |attempt: u8| {
        flood(0);
        // As long as an image, so that the connection has no room for it either.
        publisher.publish_bytes("/pose", &[attempt; 200_000], true);
        flood(100);
        let (mut before, mut last) = (None, 0);
        while before.is_none() || last != 199 {
            let heard = slow.next_within(LIMIT).unwrap().unwrap();
            match heard.topic.as_str() {
                "/lab/pose" => {
                    assert_eq!(heard.body[0], attempt);
                    before = Some(last);
                }
                "/lab/image" => last = heard.body[0],
                _ => {}
            }
        }
        before == Some(199)
    };
    assert!((0..10).any(was_dropped));
    assert!(slow.missed() > 0);
}

#[test]
fn a_slow_subscriber_gets_only_the_newest_state() {
    let publisher = publisher();
    let mut slow = Subscriber::connect(publisher.endpoint(), "/lab/").unwrap();
    until_heard(&publisher, &mut slow, "/begin");
    let mut sent = 0u32;
    let mut newest = 0;
    // More than the system and the publisher hold.
    while sent < 300 {
        newest = sent;
        let image = [&sent.to_be_bytes()[..], &[7; 200_000]].concat();
        while !publisher.publish_bytes("/image", &image, true) {
            std::thread::yield_now();
        }
        sent += 1;
    }
    let mut numbers = Vec::new();
    while numbers.last() != Some(&newest) {
        let heard = slow.next_within(LIMIT).unwrap().unwrap();
        if heard.topic == "/lab/image" {
            numbers.push(u32::from_be_bytes(heard.body[..4].try_into().unwrap()));
        }
    }
    assert!(numbers.len() < 200, "{} of {sent}", numbers.len());
    assert!(numbers.is_sorted());
    assert_eq!(slow.missed(), 0);
}

#[test]
fn encrypted_a_subscriber_hears_the_scopes_that_its_key_may_use() {
    let [own, all, lab, arm, stranger] = [(); 5].map(|()| KeyPair::generate());
    let public = own.public();
    let access = Access::everybody().with_keys(own).allow(all.public());
    let access = access.allow_scope("/lab", lab.public());
    let access = access.allow_scope("/lab/arm", arm.public());
    let publisher = Publisher::builder().access(access);
    let publisher = publisher.bind("tcp://127.0.0.1:*", "/lab").unwrap();
    let subscribe = |keys| {
        let subscriber = Subscriber::builder().keys(keys, public);
        subscriber.connect(publisher.endpoint()).unwrap()
    };
    let [mut all, mut lab, mut arm, mut stranger] = [all, lab, arm, stranger].map(subscribe);
    let wait = Duration::from_millis(10);
    while publisher.subscribers() < 3 {
        for subscriber in [&mut all, &mut lab, &mut arm, &mut stranger] {
            assert_eq!(subscriber.next_within(wait).unwrap(), None);
        }
    }
    // Below the scope of the third key, but published under another scope.
    publisher.publish_bytes("/arm/left", b"N.", false);
    publisher.publish_bytes("/arm/right", &[7; 100_000], false);
    for subscriber in [&mut all, &mut lab] {
        for topic in ["/lab/arm/left", "/lab/arm/right"] {
            assert_eq!(subscriber.next_within(LIMIT).unwrap().unwrap().topic, topic);
        }
    }
    for subscriber in [&mut arm, &mut stranger] {
        assert_eq!(subscriber.next_within(wait).unwrap(), None);
    }
    assert!(arm.is_connected() && !stranger.is_connected());
    let mut plain = Subscriber::connect(publisher.endpoint(), "").unwrap();
    assert_eq!(plain.next_within(Duration::from_millis(300)).unwrap(), None);
}

#[test]
fn a_watch_tells_of_the_first_subscriber_who_hears_the_topic_and_of_the_last() {
    let [own, lab, other] = [(); 3].map(|()| KeyPair::generate());
    let public = own.public();
    let access = Access::everybody().with_keys(own);
    let access = access.allow_scope("/lab", lab.public());
    let access = access.allow_scope("/other", other.public());
    let publisher = Publisher::builder().access(access);
    let publisher = publisher.bind("tcp://127.0.0.1:*", "/other").unwrap();
    let (tell, told) = std::sync::mpsc::channel();
    let watch = |scope: &str, path: &'static str| {
        let tell = tell.clone();
        let changed = move |is_heard| tell.send((path, is_heard)).unwrap();
        publisher.under(scope).watch(path, changed);
    };
    watch("/lab", "/arm");
    watch("/lab", "/leg");
    let subscribe = |keys: &KeyPair, topic: &str| {
        let subscriber = Subscriber::builder().keys(keys.clone(), public);
        let subscriber = subscriber.scope(topic).connect(publisher.endpoint());
        subscriber.unwrap()
    };
    let wait = Duration::from_millis(10);
    let next = |subscriber: &mut Subscriber| {
        loop {
            subscriber.next_within(wait).unwrap();
            if let Ok(told) = told.try_recv() {
                return told;
            }
        }
    };
    // It may not hear them, so nothing is told.
    let mut deaf = subscribe(&other, "");
    while publisher.subscribers() < 1 {
        deaf.next_within(wait).unwrap();
    }
    let mut arm = subscribe(&lab, "/lab/arm");
    assert_eq!(next(&mut arm), ("/arm", true));
    // Its topic begins both.
    let mut all = subscribe(&lab, "/lab");
    assert_eq!(next(&mut all), ("/leg", true));
    drop((arm, all));
    let mut ends = [next(&mut deaf), next(&mut deaf)];
    ends.sort_unstable();
    assert_eq!(ends, [("/arm", false), ("/leg", false)]);
    let mut again = subscribe(&lab, "/lab/le");
    assert_eq!(next(&mut again), ("/leg", true));
    // Who is there already is told at once.
    watch("/lab", "/leg");
    assert_eq!(next(&mut again), ("/leg", true));
    assert!(told.try_recv().is_err());
}

#[test]
fn messages_that_are_not_wanted_do_not_hold_a_subscriber_past_its_limit() {
    let publisher = publisher();
    let mut subscriber = Subscriber::connect(publisher.endpoint(), "/lab/arm").unwrap();
    until_heard(&publisher, &mut subscriber, "/arm");
    let stop = std::sync::atomic::AtomicBool::new(false);
    std::thread::scope(|scope| {
        let flood = || {
            while !stop.load(std::sync::atomic::Ordering::SeqCst) {
                publisher.publish_bytes("/arm2", b"N.", false);
            }
        };
        scope.spawn(flood);
        while subscriber
            .next_within(Duration::from_millis(100))
            .unwrap()
            .is_some()
        {}
        stop.store(true, std::sync::atomic::Ordering::SeqCst);
    });
}

#[test]
fn a_message_of_many_frames_takes_no_more_memory_than_its_bytes() {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::XPUB).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(20_000).unwrap();
    socket.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = socket.get_last_endpoint().unwrap().unwrap();
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").unwrap();
    let subscribing = std::thread::spawn(move || {
        let heard = subscriber.next_within(LIMIT).unwrap().unwrap();
        (heard.topic, subscriber.damaged())
    });
    assert_eq!(socket.recv_bytes(0).unwrap(), b"\x01/lab");
    let many = std::iter::once(&b"/lab/many"[..]).chain(std::iter::repeat_n(&b""[..], 10_000));
    socket.send_multipart(many, 0).unwrap();
    let good: [&[u8]; 2] = [b"/lab/good", b"N."];
    socket.send_multipart(good, 0).unwrap();
    assert_eq!(subscribing.join().unwrap(), ("/lab/good".to_owned(), 1));
}

#[test]
#[cfg(unix)]
fn a_subscriber_meets_a_publisher_that_was_restarted() {
    let endpoint = crate::native::own_endpoint();
    let first = Publisher::bind(&endpoint, "/lab").unwrap();
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").unwrap();
    until_heard(&first, &mut subscriber, "/one");
    drop(first);
    let second = Publisher::bind(&endpoint, "/lab").unwrap();
    until_heard(&second, &mut subscriber, "/two");
    assert_eq!(subscriber.lost(), 1);
}

#[test]
fn what_was_published_last_is_sent_before_the_publisher_closes() {
    // It waits for 1 s at most: on a busy machine, a subscriber may need longer.
    until("what was published last", PATIENCE, || {
        let publisher = publisher();
        let mut subscriber = Subscriber::connect(publisher.endpoint(), "/lab/image").unwrap();
        until_heard(&publisher, &mut subscriber, "/image");
        for number in 0..20 {
            publisher.publish_bytes("/image/last", &[number; 100_000], false);
        }
        let dropped = std::thread::spawn(move || drop(publisher));
        let mut last = Vec::new();
        while last.len() < 20 {
            let heard = subscriber.next_within(Duration::from_secs(2)).unwrap()?;
            if heard.topic == "/lab/image/last" {
                last.push(heard.body[0]);
            }
        }
        dropped.join().unwrap();
        (last == (0..20).collect::<Vec<u8>>()).then_some(())
    });
}

/// What a broken publisher may send, and what is heard of it.
#[test]
fn messages_that_are_not_ours_are_counted_and_the_next_one_is_heard() {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::XPUB).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(20_000).unwrap();
    socket.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = socket.get_last_endpoint().unwrap().unwrap();
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").unwrap();
    let subscribing = std::thread::spawn(move || {
        let heard = subscriber.next_within(LIMIT).unwrap().unwrap();
        (heard.topic, subscriber.damaged())
    });
    assert_eq!(socket.recv_bytes(0).unwrap(), b"\x01/lab");
    let one: &[&[u8]] = &[b"/lab"];
    for frames in [one, &[b"/lab", b"N.", b"N."], &[b"/lab/\xff", b"N."]] {
        socket.send_multipart(frames, 0).unwrap();
    }
    let good: [&[u8]; 2] = [b"/lab/good", b"N."];
    socket.send_multipart(good, 0).unwrap();
    assert_eq!(subscribing.join().unwrap(), ("/lab/good".to_owned(), 3));
}

#[test]
fn a_subscriber_of_libzmq_gets_its_topics_until_it_unsubscribes() {
    let publisher = publisher();
    let socket = zmq::Context::new().socket(zmq::SUB).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(20_000).unwrap();
    for topic in ["/lab/arm/", "/lab/head/pan", "/lab/done"] {
        socket.set_subscribe(topic.as_bytes()).unwrap();
    }
    socket.connect(publisher.endpoint()).unwrap();
    let long = "/arm/".to_owned() + &"x".repeat(300);
    let heard = || {
        for path in ["/arm/1", "/leg/1", "/head/tilt", "/head/pan", &long, "/ar"] {
            publisher.publish_bytes(path, &[1], false);
        }
        let mut heard = Vec::new();
        for _ in 0..2_000 {
            publisher.publish_bytes("/done", b"", false);
            while socket.poll(zmq::POLLIN, 10).unwrap() > 0 {
                let frames = socket.recv_multipart(0).unwrap();
                if frames[0] == b"/lab/done" {
                    return heard;
                }
                assert_eq!(frames[1..], [vec![1]]);
                heard.push(String::from_utf8(frames[0].clone()).unwrap());
            }
        }
        panic!("nothing arrives");
    };
    let is = |expected: &[&str]| (0..2_000).any(|_| heard() == expected);
    assert!(is(&["/lab/arm/1", "/lab/head/pan", &format!("/lab{long}")]));
    socket.set_unsubscribe(b"/lab/arm/").unwrap();
    assert!(is(&["/lab/head/pan"]), "the topic still arrives");
}

#[test]
fn a_publisher_that_checks_its_subscribers_keeps_them() {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::XPUB).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_heartbeat_ivl(100).unwrap();
    socket.set_heartbeat_timeout(20_000).unwrap();
    socket.set_heartbeat_ttl(3_000).unwrap();
    socket.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = socket.get_last_endpoint().unwrap().unwrap();
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").unwrap();
    // Longer than a handshake may take.
    let long = ztl_zmtp::HANDSHAKE + Duration::from_millis(500);
    assert_eq!(subscriber.next_within(long).unwrap(), None);
    assert!(subscriber.is_connected());
    assert_eq!(subscriber.lost(), 0);
}

#[test]
fn a_count_of_missed_messages_never_shrinks() {
    let context = zmq::Context::new();
    let socket = context.socket(zmq::XPUB).unwrap();
    socket.set_linger(0).unwrap();
    socket.set_rcvtimeo(20_000).unwrap();
    socket.bind("tcp://127.0.0.1:*").unwrap();
    let endpoint = socket.get_last_endpoint().unwrap().unwrap();
    let mut subscriber = Subscriber::connect(&endpoint, "/lab").unwrap();
    let subscribing = std::thread::spawn(move || {
        let mut missed = Vec::new();
        for _ in 0..6 {
            subscriber.next_within(LIMIT).unwrap().unwrap();
            missed.push(subscriber.missed());
        }
        missed
    });
    for topic in [&b"\x01/lab"[..], b"\x01$ztl/missed"] {
        assert_eq!(socket.recv_bytes(0).unwrap(), topic);
    }
    // As after a reconnect; then nonsense.
    for told in [
        &b"I5\n."[..],
        b"I7\n.",
        b"I2\n.",
        b"I-9\n.",
        b"I9223372036854775807\n.",
        b"I1\n.",
    ] {
        let count: [&[u8]; 2] = [b"$ztl/missed", told];
        socket.send_multipart(count, 0).unwrap();
        let event: [&[u8]; 2] = [b"/lab/", b"N."];
        socket.send_multipart(event, 0).unwrap();
    }
    let last = 9 + 9_223_372_036_854_775_807;
    assert_eq!(subscribing.join().unwrap(), [5, 7, 9, 9, last, last + 1]);
}

/// Completes with its goal; rejects every other component.
struct Echo;

impl TaskController for Echo {
    fn assign(&self, request: &TaskRequest) -> Result<Box<dyn ExecutableTask>, TaskError> {
        let goal = request.goal.clone();
        match request.component.as_str() {
            "echo" => Ok(Box::new(move |context: &TaskContext| {
                context.progress("half way");
                Ok::<_, TaskError>(goal.clone())
            })),
            other => Err(format!("no component '{other}'").into()),
        }
    }
}

#[test]
fn a_server_publishes_what_happens_to_its_tasks() {
    let mut server = TaskServer::bind("tcp://127.0.0.1:*").unwrap();
    let publisher = server.publish_events("tcp://127.0.0.1:*").unwrap();
    let events = publisher.endpoint().to_owned();
    for scope in ["/lab", "/other"] {
        server.register(scope, Echo);
    }
    let server = server.spawn().unwrap();
    let mut subscriber = Subscriber::connect(&events, "/lab").unwrap();
    let [mut lab, mut other] =
        ["/lab", "/other"].map(|scope| RemoteTask::connect(server.endpoint(), scope).unwrap());
    // Until the subscription has arrived.
    let wait = Duration::from_millis(20);
    while subscriber.next_within(wait).unwrap().is_none() {
        lab.run("robot", "echo", "begin", Some(LIMIT)).unwrap();
    }
    other.run("robot", "echo", "hidden", Some(LIMIT)).unwrap();
    let ended = lab.run("robot", "echo", "a:b", Some(LIMIT)).unwrap();
    lab.trigger("robot", "dance", "now").unwrap_err();
    let mut events = Vec::new();
    while events.last() != Some(&"REJECTED None no component 'dance'".to_owned()) {
        let heard = subscriber.next_within(LIMIT).unwrap().unwrap();
        let pickle = heard.value().unwrap();
        let value = pickle.value();
        let text = |name: &str| value.get(name).and_then(|value| value.as_str());
        let id = value.get("id").unwrap().as_f64().unwrap();
        assert_eq!(heard.topic, format!("/lab/$tasks/{id}"));
        assert!(value.get("time").unwrap().as_f64().unwrap() > 1.7e9);
        let goal = text("goal").unwrap_or("None");
        if goal == "a:b" {
            events.clear();
            assert_eq!(
                [text("handler"), text("component")],
                [Some("robot"), Some("echo")]
            );
            assert_eq!(text("client").unwrap().len(), 32);
        }
        let text = text("text").unwrap_or("None");
        let state = value.get("state").unwrap().as_str().unwrap();
        events.push(format!("{state} {goal} {text}"));
    }
    // A quick task may have ended before its acceptance or its progress was taken.
    events.retain(|event| !event.starts_with("ACCEPTED"));
    assert_eq!(ended.text, "a:b");
    assert_eq!(
        events,
        [
            "INITIATED a:b None",
            "COMPLETED None a:b",
            "INITIATED now None",
            "REJECTED None no component 'dance'",
        ]
    );
}
