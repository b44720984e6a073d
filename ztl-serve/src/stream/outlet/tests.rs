use std::path::Path;

use ztl_std::Subscriber;
use ztl_tests::lab::{PATIENCE, until};
use ztl_yaml::Document;

use super::*;
use crate::Config;

/// The outlet of a stream with these settings.
fn outlet(settings: &str, is_heard: bool) -> Outlet {
    let text = format!("streams: {{/r: {{s: {{run: [x], {settings}}}}}}}");
    let document = Document::parse("robot.yaml", text.as_bytes()).expect("YAML");
    let config = Config::read(&document, Path::new("/")).expect("a stream");
    let [config] = config.streams.as_slice() else {
        panic!("{config:?}");
    };
    let publisher = Publisher::bind("tcp://127.0.0.1:*", "/r").expect("a port");
    let is_heard = Arc::new(AtomicBool::new(is_heard));
    Outlet::new(Arc::clone(config), publisher, is_heard)
}

#[test]
fn a_late_value_does_not_make_the_rate_lower() {
    let start = Instant::now();
    let at = |millis| start + Duration::from_millis(millis);
    let mut outlet = outlet("frame: line, rate: 100 Hz", true);
    outlet.handle(start, Piece::Frame(b"first"));
    assert_eq!(outlet.poll_timeout(), None);
    // Each one goes out 3 ms late.
    for turn in 1..20 {
        outlet.handle(at(10 * turn - 1), Piece::Frame(b"next"));
        assert_eq!(outlet.poll_timeout(), Some(at(10 * turn)));
        outlet.handle_timeout(at(10 * turn + 3));
        assert_eq!(outlet.poll_timeout(), None);
    }
    // After a pause, the time counts from the next value.
    outlet.handle(at(1005), Piece::Frame(b"at once"));
    outlet.handle(at(1006), Piece::Frame(b"later"));
    assert_eq!(outlet.poll_timeout(), Some(at(1015)));
}

#[test]
fn the_rest_of_dropped_frames_is_logged_later() {
    let start = Instant::now();
    let mut outlet = outlet("frame: json", false);
    outlet.handle(start, Piece::Frame(b"nonsense"));
    assert_eq!((outlet.dropped, outlet.poll_timeout()), (0, None));
    for _ in 0..3 {
        outlet.handle(start, Piece::Frame(b"nonsense"));
    }
    assert_eq!(outlet.dropped, 3);
    assert_eq!(outlet.poll_timeout(), Some(start + QUIET));
    outlet.handle_timeout(start + QUIET);
    assert_eq!((outlet.dropped, outlet.poll_timeout()), (0, None));
}

#[test]
fn what_nobody_subscribes_to_is_published_only_if_it_is_the_latest() {
    let now = Instant::now();
    for (latest, expected) in [(false, "heard"), (true, "unheard")] {
        let mut outlet = outlet(&format!("frame: line, latest: {latest}"), false);
        outlet.handle(now, Piece::Frame(b"unheard"));
        let endpoint = outlet.publisher.endpoint().to_owned();
        let mut subscriber = Subscriber::connect(&endpoint, "/r").expect("a file");
        let mut first = None;
        until("a subscriber", PATIENCE, || {
            let heard = subscriber.next_within(Duration::from_millis(20));
            first = first.take().or(heard.expect("it can wait"));
            (outlet.publisher.subscribers() > 0).then_some(())
        });
        outlet.is_heard.store(true, Ordering::Release);
        outlet.handle(now, Piece::Frame(b"heard"));
        let mut next = || subscriber.next_within(PATIENCE).expect("it can wait");
        let first = first.or_else(&mut next).expect("a message");
        let value = first.value().expect("plain data");
        assert_eq!(value.value().repr().to_string(), format!("'{expected}'"));
    }
}
