//! Messages of a robot's streams, from its agent to an endpoint (`ztl-fleet/src/streams.rs`).
//!
//! The first byte chooses what the rest is: a message, which is a line of JSON and a value; or a byte for a length, a topic and
//! the scopes of its robot, with a zero byte between them.

use ztl_core::Instant;
use ztl_core::topic::is_below;
use ztl_fleet::streams::{
    Granted, Head, Incoming, LONGEST_TOPIC, fewest, is_wanted, scope_of, topics_of,
};

const ROBOT: &str = "arm";

/// Any input.
pub fn check(bytes: &[u8]) {
    match bytes.split_first() {
        Some((choice, rest)) if choice % 2 == 0 => message(rest),
        Some((_, rest)) => passed_on(rest),
        None => {}
    }
}

/// The endpoint gets these bytes.
fn message(bytes: &[u8]) {
    let Some((head, body)) = Head::parse(bytes) else {
        return;
    };
    let (line, value) = bytes.split_at(bytes.len() - body.len());
    assert_eq!(
        line.iter().position(|byte| *byte == b'\n'),
        Some(line.len() - 1)
    );
    assert_eq!(value, body);
    head_is_kept(&head, body);
    is_taken_once(&head);
    let (topic, scope) = (&head.topic, &head.scope);
    let Some(place) = place(&head) else {
        return;
    };
    // Everybody with the right to the scope hears the message, so the scope must be the right one.
    let of_scope = scope.as_ref().map(|scope| format!("/{ROBOT}{scope}"));
    let is_told = place == format!("/{ROBOT}") || Some(place) == of_scope;
    assert!(is_told, "{topic:?} with the scope {scope:?} has another");
}

/// The agent passes a message of this topic on.
fn passed_on(bytes: &[u8]) {
    let Some((length, text)) = bytes.split_first() else {
        return;
    };
    let Ok(text) = str::from_utf8(text) else {
        return;
    };
    let mut parts = text.split('\0').map(str::to_owned);
    let topic = parts.next().unwrap_or_default();
    let scopes: Vec<String> = parts.collect();
    let scope = scope_of(&topic, &scopes).map(str::to_owned);
    let is_above = |scope: &&String| is_below(topic.as_bytes(), scope.as_bytes());
    if let Some(scope) = &scope {
        assert!(is_above(&scope), "{topic:?} is not in the scope {scope:?}");
    }
    // The topic of a task names its scope. Any other may belong to several, which not everybody may use.
    if !topic.contains("/$tasks/") {
        let is_only_one = scopes.iter().filter(is_above).count() == 1;
        assert_eq!(scope.is_some(), is_only_one, "{topic:?} in {scopes:?}");
    }
    let head = Head {
        session: "7".repeat(32),
        number: u64::from(*length),
        topic,
        scope,
        state: length % 2 == 0,
    };
    head_is_kept(&head, bytes);
    is_taken_once(&head);
    place(&head);
    // Whoever subscribes at the endpoint to the beginning of its topic has it sent.
    let topic = &head.topic;
    let there = topic_at_endpoint(topic);
    let begin = there.as_bytes().get(..usize::from(*length));
    let wanted = topics_of(begin.unwrap_or(there.as_bytes()), ROBOT);
    assert!(is_wanted(topic, &wanted), "{topic:?} is not in {wanted:?}");
    let all = [wanted, head.scope.into_iter().collect(), scopes].concat();
    let are_taken = all.iter().all(|topic| topic.len() <= LONGEST_TOPIC);
    if are_taken {
        // The subscribers may hear everything.
        assert!(is_wanted(topic, &fewest(all, || vec![String::new()])));
    }
}

/// What is written is read as the same.
fn head_is_kept(head: &Head, body: &[u8]) {
    let written = head.with(body);
    assert_eq!(Head::parse(&written), Some((head.clone(), body)));
}

/// A copy of a message says nothing.
fn is_taken_once(head: &Head) {
    let mut incoming = Incoming::default();
    assert_eq!(incoming.on_message(head, 1), None);
    let granted = Granted {
        session: head.session.clone(),
        sent: 0,
        window: 0,
        problem: None,
    };
    incoming.on_answer(Instant::ZERO, &granted);
    // All before it were missed.
    assert_eq!(incoming.on_message(head, 1), head.number.checked_sub(1));
    assert_eq!(incoming.on_message(head, 1), None);
}

/// A robot's topic, as subscribers at the endpoint know it.
fn topic_at_endpoint(topic: &str) -> String {
    let slash = if topic.starts_with('/') { "" } else { "/" };
    format!("/{ROBOT}{slash}{topic}")
}

/// The scope of a message at the endpoint. The message has the robot's topic, which is below the scope; a reserved topic has none.
fn place(head: &Head) -> Option<String> {
    let place = head.place(ROBOT);
    assert_eq!(place.is_none(), head.topic.starts_with('$'));
    let (scope, path) = place?;
    let topic = format!("{scope}{path}");
    assert_eq!(topic, topic_at_endpoint(&head.topic));
    assert!(is_below(topic.as_bytes(), scope.as_bytes()));
    Some(scope)
}
