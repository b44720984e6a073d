use std::sync::mpsc::{Receiver, channel};

use ztl_tests::lab::until;

use super::*;
use crate::Publisher;

const LIMIT: Duration = Duration::from_secs(20);

fn text(topics: &[&str]) -> Vec<String> {
    topics.iter().map(|topic| (*topic).to_owned()).collect()
}

/// The next message, and whether it is a state.
#[track_caller]
fn next(subscriber: &mut RelaySubscriber) -> (String, Vec<u8>, bool) {
    let heard = subscriber.next_within(LIMIT).unwrap();
    let (heard, is_state) = heard.expect("a message");
    (heard.topic, heard.body, is_state)
}

fn told(topic: &str, body: &[u8], is_state: bool) -> (String, Vec<u8>, bool) {
    (topic.to_owned(), body.to_vec(), is_state)
}

#[test]
fn a_relay_learns_what_is_a_state_and_gets_the_newest_ones_again() {
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/lab").unwrap();
    publisher.publish_bytes("/pose", b"1", true);
    let mut relay = RelaySubscriber::connect(publisher.endpoint(), None).unwrap();
    relay.set_topics(&text(&["/lab/"]));
    assert_eq!(next(&mut relay), told("/lab/pose", b"1", true));
    publisher.publish_bytes("/word", b"2", false);
    publisher.publish_bytes("/pose", b"3", true);
    publisher.publish_bytes("/word", b"4", false);
    assert_eq!(next(&mut relay), told("/lab/word", b"2", false));
    assert_eq!(next(&mut relay), told("/lab/pose", b"3", true));
    assert_eq!(next(&mut relay), told("/lab/word", b"4", false));
    relay.ask_newest();
    assert_eq!(next(&mut relay), told("/lab/pose", b"3", true));
    // Other topics are added to, or taken from, the same connection.
    publisher.publish_bytes("/door", b"5", true);
    assert_eq!(next(&mut relay), told("/lab/door", b"5", true));
    relay.set_topics(&text(&["/lab/door", "/other"]));
    assert_eq!(next(&mut relay), told("/lab/door", b"5", true));
    relay.ask_newest();
    assert_eq!(next(&mut relay), told("/lab/door", b"5", true));
    publisher.publish_bytes("/pose", b"6", true);
    publisher.publish_bytes("/door", b"7", true);
    assert_eq!(next(&mut relay), told("/lab/door", b"7", true));
    assert_eq!((relay.missed(), relay.lost()), (0, 0));
}

#[test]
fn a_topic_with_an_exception_does_not_bring_nor_watch_it() {
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/lab").unwrap();
    let hidden = publisher.under("/lab/priv");
    let (sender, watched) = channel();
    hidden.watch("/x", move |is_watched| sender.send(is_watched).unwrap());
    hidden.publish_bytes("/x", b"1", true);
    publisher.publish_bytes("/pose", b"2", true);
    let mut relay = RelaySubscriber::connect(publisher.endpoint(), None).unwrap();
    relay.set_topics(&text(&["/lab/\n/lab/q/\n/lab/priv/", "/other"]));
    assert_eq!(next(&mut relay), told("/lab/pose", b"2", true));
    for _ in 0..2 {
        hidden.publish_bytes("/x", b"3", false);
        publisher.publish_bytes("/word", b"4", true);
        // A new subscription brings the newest states again.
        let mut heard = std::iter::from_fn(|| Some(next(&mut relay).0));
        let hidden = heard.find(|topic| topic != "/lab/pose");
        assert_eq!(hidden.as_deref(), Some("/lab/word"));
        // Nor after it was taken back and asked for again.
        relay.set_topics(&text(&["/other"]));
        relay.set_topics(&text(&["/lab\n/lab/priv/", "/other"]));
    }
    assert!(watched.try_recv().is_err(), "the exception is watched");
    // Another topic brings it.
    relay.set_topics(&text(&["/lab\n/lab/priv/", "/lab/p"]));
    assert!(watched.recv_timeout(LIMIT).unwrap());
    let mut heard = std::iter::from_fn(|| Some(next(&mut relay)));
    assert!(heard.any(|heard| heard == told("/lab/priv/x", b"1", true)));
}

#[test]
fn a_publisher_whose_thread_has_ended_says_so() {
    let changed = |_: Vec<WantedTopic>| panic!("this is a test");
    let everybody = Access::everybody();
    let publisher =
        RelayPublisher::bind("tcp://127.0.0.1:*", everybody, Limits::default(), changed);
    let publisher = publisher.unwrap();
    // It is told at once that nobody subscribes to anything.
    let begun = std::time::Instant::now();
    while !publisher.has_ended() {
        assert!(begun.elapsed() < LIMIT);
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn a_state_in_a_long_queue_is_told_as_one() {
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/lab").unwrap();
    let mut relay = RelaySubscriber::connect(publisher.endpoint(), None).unwrap();
    relay.set_topics(&text(&[""]));
    publisher.publish_bytes("/begin", b"", true);
    next(&mut relay);
    let long = vec![7; 1 << 20];
    for _ in 0..6 {
        assert!(publisher.publish_bytes("/image", &long, false));
        assert!(publisher.publish_bytes("/pose", b"x", true));
    }
    let mut states = 0;
    let mut images = 0;
    while images < 6 {
        let (topic, _, is_state) = next(&mut relay);
        assert_eq!(is_state, topic == "/lab/pose");
        states += usize::from(is_state);
        images += usize::from(!is_state);
    }
    assert!(states <= 6);
}

fn bound() -> (RelayPublisher, Receiver<Vec<WantedTopic>>) {
    let (sender, wanted) = channel();
    let changed = move |wanted| drop(sender.send(wanted));
    let everybody = Access::everybody();
    let bound = RelayPublisher::bind("tcp://127.0.0.1:*", everybody, Limits::default(), changed);
    (bound.unwrap(), wanted)
}

/// Whether these topics are wanted.
fn are(wanted: &[WantedTopic], topics: &[&str]) -> bool {
    let mut begins: Vec<_> = wanted.iter().map(|one| one.begin.clone()).collect();
    begins.sort();
    begins == topics.iter().map(|t| t.as_bytes()).collect::<Vec<_>>()
}

/// Waits until these topics are wanted.
#[track_caller]
fn wait_for(wanted: &Receiver<Vec<WantedTopic>>, topics: &[&str]) {
    while !are(&wanted.recv_timeout(LIMIT).unwrap(), topics) {}
}

#[test]
fn a_relay_tells_what_is_wanted_and_forgets_what_nobody_keeps_up_to_date() {
    let (publisher, wanted) = bound();
    let mut first = Subscriber::connect(publisher.endpoint(), "/arm/lab").unwrap();
    // A subscriber connects while it is waited for.
    until("its topic is wanted", LIMIT, || {
        let turn = first.next_within(Duration::from_millis(100));
        assert_eq!(turn.unwrap().map(|heard| heard.topic), None);
        let mut told = wanted.try_iter();
        told.any(|wanted| are(&wanted, &["/arm/lab"])).then_some(())
    });
    assert!(publisher.publish("/arm", "/arm/lab", "/pose", b"1", true));
    assert!(publisher.publish("/arm", "/arm/lab", "/door", b"2", true));
    publisher.forget(|topic| topic == b"/arm/lab/pose");
    let mut late = Subscriber::connect(publisher.endpoint(), "/arm/lab/").unwrap();
    let heard = late.next_within(LIMIT).unwrap().unwrap();
    assert_eq!(
        (heard.topic.as_str(), heard.body),
        ("/arm/lab/door", b"2".to_vec())
    );
    wait_for(&wanted, &["/arm/lab", "/arm/lab/"]);
    drop(first);
    wait_for(&wanted, &["/arm/lab/"]);
    // What was published before it is forgotten stays so.
    assert!(publisher.publish("/arm", "/arm/lab", "/pose", b"3", true));
    let heard = late.next_within(LIMIT).unwrap().unwrap();
    assert_eq!(heard.body, b"3");
}

#[test]
fn who_may_hear_a_robot_learns_that_its_messages_were_missed() {
    let [own, anna, other] = [(); 3].map(|()| KeyPair::generate());
    let access = Access::everybody().with_keys(own.clone());
    let access = access.allow_scope("/arm", anna.public());
    let access = access.allow_scope("/leg/lab", other.public());
    let bound = RelayPublisher::bind("tcp://127.0.0.1:*", access, Limits::default(), drop);
    let publisher = bound.unwrap();
    let subscribe = |keys: &KeyPair| {
        let builder = Subscriber::builder().keys(keys.clone(), own.public());
        builder.connect(publisher.endpoint()).unwrap()
    };
    let (mut anna, mut other) = (subscribe(&anna), subscribe(&other));
    // Each hears its own only: the whole robot, or a scope of it.
    for (subscriber, topic) in [(&mut anna, "/arm/lab/x"), (&mut other, "/leg/lab/x")] {
        let heard = loop {
            publisher.publish("/arm", "/arm/lab", "/x", b"1", false);
            publisher.publish("/leg", "/leg/lab", "/x", b"1", false);
            publisher.publish("/leg", "/leg/other", "/x", b"1", false);
            let heard = subscriber.next_within(Duration::from_millis(10)).unwrap();
            if let Some(heard) = heard {
                break heard;
            }
        };
        assert_eq!(heard.topic, topic);
    }
    let mut missed = |root: &str, scope: &str, count| {
        publisher.tell_missed(root, vec![scope.to_owned()], count);
        // It is told with the next messages.
        publisher.publish("/arm", "/arm/lab", "/end", b"", false);
        publisher.publish("/leg", "/leg/lab", "/end", b"", false);
        for subscriber in [&mut anna, &mut other] {
            while !subscriber
                .next_within(LIMIT)
                .unwrap()
                .unwrap()
                .topic
                .ends_with("/end")
            {}
        }
        (anna.missed(), other.missed())
    };
    assert_eq!(missed("/arm", "/arm/lab", 3), (3, 0));
    assert_eq!(missed("/leg", "/leg/lab", 3), (3, 3));
    assert_eq!(missed("/leg", "/leg/other", 3), (3, 3));
    assert_eq!(missed("/ar", "/ar/lab", 3), (3, 3));
    // A robot may say anything.
    assert_eq!(missed("/arm", "/arm/lab", u64::MAX).1, 3);
    assert_eq!(missed("/arm", "/arm/lab", u64::MAX).1, 3);
}
