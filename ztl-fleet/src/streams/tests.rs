use super::*;

const ID: &str = "0123456789abcdef0123456789abcdef";

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn head(session: &str, number: u64) -> Head {
    Head {
        session: session.to_owned(),
        number,
        topic: "/lab/pose".to_owned(),
        scope: Some("/lab".to_owned()),
        state: false,
    }
}

fn granted(session: &str, sent: u64) -> Granted {
    Granted {
        session: session.to_owned(),
        sent,
        window: 0,
        problem: None,
    }
}

/// An endpoint that the agent has told a session.
fn incoming(session: &str) -> Incoming {
    let mut incoming = Incoming::default();
    assert_eq!(incoming.on_answer(at(0), &granted(session, 0)), (0, true));
    incoming
}

#[test]
fn a_message_of_another_session_or_from_a_recording_is_refused() {
    let mut end = Incoming::default();
    assert_eq!(end.on_message(&head("a", 1), 1), None);
    end = incoming("a");
    assert_eq!(end.on_message(&head("a", 1), 1), Some(0));
    assert_eq!(end.on_message(&head("a", 1), 1), None);
    assert_eq!(end.on_message(&head("b", 2), 1), None);
    assert_eq!(end.on_message(&head("a", 4), 1), Some(2));
    for old in [2, 3, 4] {
        assert_eq!(end.on_message(&head("a", old), 1), None);
    }
    // The agent was restarted: its numbers begin at 1, and the old ones say nothing.
    assert_eq!(end.on_answer(at(1), &granted("b", 0)), (1, true));
    assert_eq!(end.on_message(&head("a", 5), 1), None);
    assert_eq!(end.on_message(&head("b", 1), 1), Some(0));
}

#[test]
fn what_was_lost_at_the_end_is_missed_once_and_the_newest_states_are_asked_for() {
    let mut end = incoming("a");
    let topics = [String::new()];
    assert_eq!(end.on_message(&head("a", 1), 1), Some(0));
    assert_eq!(end.on_answer(at(10), &granted("a", 3)), (0, false));
    // They may be under way.
    assert_eq!(end.on_answer(at(20), &granted("a", 3)), (0, false));
    assert!(!end.want(ID, &topics).newest);
    assert_eq!(end.on_answer(at(1010), &granted("a", 3)), (2, false));
    let want = end.want(ID, &topics);
    assert_eq!((want.heard, want.newest), (3, true));
    assert!(!end.want(ID, &topics).newest);
    assert_eq!(end.on_answer(at(2010), &granted("a", 3)), (0, false));
    assert_eq!(end.on_message(&head("a", 4), 1), Some(0));
}

#[test]
fn an_agent_sends_no_more_than_its_window_until_it_is_heard_or_lost() {
    const KIB: usize = 1 << 10;
    let mut end = Outgoing::default();
    let mut sent = 0;
    while end.may_send(at(0)) {
        sent = end.send(at(0), 64 * KIB);
    }
    assert_eq!(sent, 4);
    end.on_heard(at(10), 1);
    assert!(end.may_send(at(10)));
    assert_eq!(end.send(at(500), 256 * KIB), 5);
    assert!(!end.may_send(at(1999)));
    assert!(end.may_send(at(2000)));
    end.skip(2);
    assert_eq!(end.send(at(2000), 1), 8);
    // A message that is longer than the window goes alone.
    let mut end = Outgoing::default();
    end.send(at(0), LONGEST);
    assert!(!end.may_send(at(0)));
    end.on_heard(at(1), 1);
    assert!(end.may_send(at(1)));
}

#[test]
fn few_small_messages_are_on_their_way_at_once_since_requests_wait_behind_them() {
    let mut end = Outgoing::default();
    // A line that carries anything at once has the longest window.
    for now in 0..100 {
        while end.may_send(at(now)) {
            end.send(at(now), 100);
        }
        end.on_heard(at(now), end.sent());
    }
    assert_eq!(end.window(), WINDOWS.1);
    let before = end.sent();
    while end.may_send(at(100)) {
        end.send(at(100), 100);
    }
    let count = end.sent() - before;
    assert!((900..1100).contains(&count), "{count}");
}

#[test]
fn the_window_fits_what_the_line_carries_at_once() {
    /// Milliseconds, and the bytes that wait on the line after that time.
    fn flood(bytes_per_ms: usize, pause: u64) -> (Outgoing, usize) {
        let (mut agent, mut end) = (Outgoing::default(), incoming("a"));
        end.window = agent.window();
        let mut line: VecDeque<(u64, usize)> = VecDeque::new();
        let mut carried = 0;
        for now in 0..10_000 {
            while now % pause == 0 && agent.may_send(at(now)) {
                let number = agent.send(at(now), 16 << 10);
                line.push_back((number, 16 << 10));
            }
            carried += bytes_per_ms;
            while let Some((number, bytes)) = line.front().copied()
                && carried >= bytes
            {
                carried -= bytes;
                line.pop_front();
                assert!(end.on_message(&head("a", number), bytes).is_some());
                if end.is_due() {
                    agent.on_heard(at(now), end.want(ID, &[]).heard);
                    end.window = agent.window();
                }
            }
            if line.is_empty() {
                carried = 0;
            }
        }
        let waits = line.iter().map(|(_, bytes)| bytes).sum();
        (agent, waits)
    }
    // 500 KB a second: what comes last waits for less than half a second.
    let (_, waits) = flood(500, 1);
    assert!(waits <= 250_000, "{waits}");
    // 100 MB a second are used.
    let (agent, _) = flood(100_000, 1);
    assert_eq!(agent.window(), WINDOWS.1);
    // A quiet stream does not shrink it.
    let mut agent = Outgoing::default();
    for second in 0..100 {
        let number = agent.send(at(second * 1000), 100);
        agent.on_heard(at(second * 1000 + 900), number);
    }
    assert!(agent.window() > FIRST_WINDOW);
}

/// A small generator of numbers, always the same for a seed.
struct Random(u64);

impl Random {
    fn below(&mut self, most: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % most
    }
}

#[test]
fn each_message_arrives_once_in_order_or_is_told_as_missed_whatever_the_network_does() {
    for seed in 1..=2000 {
        let mut random = Random(seed);
        let (mut agent, mut end) = (Outgoing::default(), incoming("a"));
        let mut network: Vec<(Head, usize)> = Vec::new();
        let mut recorded = Vec::new();
        let (mut now, mut arrived, mut missed, mut last) = (0, 0, 0, 0);
        let mut take = |end: &mut Incoming, (head, bytes): (Head, usize)| {
            if let Some(before) = end.on_message(&head, bytes) {
                assert!(head.number > last, "seed {seed}");
                last = head.number;
                arrived += 1;
                missed += before;
            }
        };
        let ask = |agent: &mut Outgoing, end: &mut Incoming, now: u64, is_lost: bool| {
            let want = end.want(ID, &[]);
            agent.on_heard(at(now), want.heard);
            let granted = granted("a", agent.sent());
            if is_lost {
                return 0;
            }
            end.on_answer(at(now), &granted).0
        };
        let mut told = 0;
        for _ in 0..200 {
            now += random.below(400);
            match random.below(6) {
                0 | 1 if agent.may_send(at(now)) => {
                    let bytes = 1 + random.below(1 << 18) as usize;
                    let number = agent.send(at(now), bytes);
                    network.push((head("a", number), bytes));
                    recorded.push((head("a", number), bytes));
                }
                2 => agent.skip(random.below(3)),
                3 if !network.is_empty() => {
                    // Lost, late, doubled or in order.
                    let at = random.below(network.len() as u64) as usize;
                    let message = network.remove(at);
                    match random.below(4) {
                        0 => {}
                        1 => {
                            take(&mut end, message.clone());
                            take(&mut end, message);
                        }
                        _ => take(&mut end, message),
                    }
                }
                4 if !recorded.is_empty() => {
                    let at = random.below(recorded.len() as u64) as usize;
                    take(&mut end, recorded[at].clone());
                }
                _ => told += ask(&mut agent, &mut end, now, random.below(3) == 0),
            }
        }
        // All that is still under way is lost.
        for _ in 0..3 {
            now += 1000;
            told += ask(&mut agent, &mut end, now, false);
        }
        assert_eq!(arrived + missed + told, agent.sent(), "seed {seed}");
        assert!(agent.may_send(at(now)));
    }
}

#[test]
fn topics_of_an_endpoint_mean_topics_of_robots_as_zeromq_compares_them() {
    let everything = [""];
    for all in ["", "/", "/ar", "/arm", "/arm/"] {
        assert_eq!(topics_of(all.as_bytes(), "arm"), everything, "{all}");
    }
    assert_eq!(topics_of(b"/arm/lab", "arm"), ["/lab", "lab"]);
    for others in ["/arm2", "/leg/lab", "arm", "/arms/"] {
        assert!(topics_of(others.as_bytes(), "arm").is_empty(), "{others}");
    }
    // Clients of an endpoint cannot write exceptions.
    assert_eq!(topics_of(b"/arm/lab\n/lab/x", "arm"), ["/lab", "lab"]);
    // A topic may end within a character, but not contain bytes that no text has.
    assert_eq!(topics_of(b"/arm/t\xc3", "arm"), ["/t", "t"]);
    assert!(topics_of(b"/arm/t\xff/", "arm").is_empty());
    let owned = |topics: &[&str]| topics.iter().map(|topic| (*topic).to_owned()).collect();
    let fewest = |topics| fewest(topics, || panic!("they are few"));
    assert_eq!(fewest(owned(&["/b", "/a", "/ab", "/b/c"])), ["/a", "/b"]);
    let long = format!("/{}", "x".repeat(LONGEST_TOPIC));
    assert_eq!(fewest(vec![long, "/a".to_owned()]), ["/a"]);
}

#[test]
fn too_many_topics_become_all_that_their_subscribers_may_hear_and_no_more() {
    let many = |root| (0..=MOST_TOPICS).map(move |number| format!("{root}/{number:03}"));
    let lab = || vec!["/lab/\n/lab/priv/".to_owned(), "/lab/x".to_owned()];
    assert_eq!(fewest(many("/lab").collect(), lab), lab());
    let scopes = || many("").collect();
    let kept = fewest(many("/lab").collect(), scopes);
    assert_eq!(kept.len(), MOST_TOPICS);
    assert!(kept.iter().all(|topic| scopes().contains(topic)));
}

#[test]
fn a_message_belongs_to_one_scope_or_to_the_whole_robot() {
    let scopes = ["/lab", "/lab/left", "/hall"].map(str::to_owned);
    for (topic, scope) in [
        ("/hall/pose", Some("/hall")),
        ("/lab/pose", Some("/lab")),
        // Of the one or of the other.
        ("/lab/left/pose", None),
        ("/lab/left/$tasks/7", Some("/lab/left")),
        ("/other/$tasks/7", Some("/other")),
        ("x/$tasks/7", None),
        ("gripper/finger", None),
        ("/halls/pose", None),
    ] {
        assert_eq!(scope_of(topic, &scopes), scope, "{topic}");
    }
    let place = |topic: &str, scope: Option<&str>| {
        let head = Head {
            topic: topic.to_owned(),
            scope: scope.map(str::to_owned),
            ..head("a", 1)
        };
        let (scope, path) = head.place("arm")?;
        Some(format!("{scope} {path}"))
    };
    let told = |text: &str| Some(text.to_owned());
    assert_eq!(place("/lab/pose", Some("/lab")), told("/arm/lab /pose"));
    assert_eq!(place("gripper/x", None), told("/arm /gripper/x"));
    // A scope that the topic does not have gives no rights.
    for odd in ["/la", "/leg", "lab", "/lab/pose/", ""] {
        assert_eq!(
            place("/lab/pose", Some(odd)),
            told("/arm /lab/pose"),
            "{odd}"
        );
    }
    assert_eq!(place("$ztl/missed", None), None);
}

#[test]
fn messages_round_trip_and_odd_ones_say_nothing() {
    let first = Head {
        topic: "/lab/ü\n".to_owned(),
        ..head("a", 7)
    };
    let message = first.with(b"\n1\n");
    assert_eq!(Head::parse(&message), Some((first, &b"\n1\n"[..])));
    for odd in [&b""[..], b"\n", b"{}\n", b"[]\nx", b"\xff\n"] {
        assert_eq!(Head::parse(odd), None);
    }
}

#[test]
fn of_topics_that_begin_so_only_the_part_in_these_scopes_is_left() {
    let parts = |begin: &str| {
        let parts = within(
            &[begin.to_owned()],
            &["/lab", "/arm/left", "/arm/left/hand/thumb"],
            &["/arm", "/arm/left/hand", "/arm/left/eye", "/labor"],
        );
        parts.join(" ").replace('\n', " except ")
    };
    let left = "/arm/left/ except /arm/left/eye/ except /arm/left/hand/";
    let thumb = "/arm/left/hand/thumb/";
    for (begin, left) in [
        ("", format!("{left} {thumb} /lab/").as_str()),
        ("/arm/", &format!("{left} {thumb}")),
        (
            "/arm/left/h",
            &format!("/arm/left/h except /arm/left/hand/ {thumb}"),
        ),
        ("/arm/left/hand/", thumb),
        ("/arm/left/hand/x", ""),
        ("/arm/left/pose", "/arm/left/pose"),
        // Exceptions stay.
        ("/lab/\n/lab/a/", "/lab/ except /lab/a/"),
        ("/lab/a/b\n/lab/a/", ""),
        ("/\n/lab/a/\n/arm/", "/lab/ except /lab/a/"),
        ("/l", "/lab/"),
        ("/lab", "/lab/"),
        ("/lab/", "/lab/"),
        ("/lab/po", "/lab/po"),
        ("/labor", ""),
        ("lab/", ""),
    ] {
        assert_eq!(parts(begin), left, "{begin}");
    }
    let topics = ["/lab/\n/lab/a/\n/lab/b/".to_owned()];
    assert!(is_wanted("/lab/pose", &topics));
    for other in ["/lab/a/x", "/lab/b/", "/other"] {
        assert!(!is_wanted(other, &topics), "{other}");
    }
    // Exceptions of one topic do not cover those of another.
    let owned = |all: &[&str]| all.iter().map(|&topic| topic.to_owned()).collect();
    let both = owned(&["/lab/\n/lab/a/", "/lab/\n/lab/a/b/"]);
    let fewest = |topics| fewest(topics, Vec::new);
    assert_eq!(fewest(Vec::clone(&both)), both);
    let more = owned(&["/lab/\n/lab/a/", "/lab/\n/lab/a/\n/lab/b/"]);
    assert_eq!(fewest(more), ["/lab/\n/lab/a/"]);
    assert_eq!(fewest(owned(&["/lab/", "/lab/\n/lab/a/"])), ["/lab/"]);
}
