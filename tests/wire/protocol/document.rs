//! The tables and statements of the document, compared with the code.

use std::time::Duration;

use ztl_core::dispatcher::{Body, Config, Dispatcher, HOLD, KEEP_INIT, LONGEST_WAIT, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::{Event, Instant, Request, State, TaskId};
use ztl_std::{RemoteTask, RequestError};
use ztl_tests::lab::reserve_port;

use crate::socket::TIMEOUT;

const DOCUMENT: &str = include_str!("../../../docs/protocol.md");

/// Lines in a fence, each with its number in the document.
pub(crate) struct Block {
    pub(crate) lines: Vec<(usize, &'static str)>,
}

/// The fenced blocks of this kind.
pub(crate) fn blocks(kind: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut lines = (1..).zip(DOCUMENT.lines());
    while let Some((_, line)) = lines.next() {
        let Some(fence) = line.strip_prefix("```") else {
            continue;
        };
        let block = lines.by_ref().take_while(|(_, line)| *line != "```");
        let lines = block.collect();
        if fence == kind {
            blocks.push(Block { lines });
        }
    }
    blocks
}

/// The rows of the table whose head begins so, cut into cells.
#[track_caller]
fn table(head: &str) -> Vec<Vec<&'static str>> {
    let lines = DOCUMENT.lines().skip_while(|line| !line.starts_with(head));
    let rows = lines.skip(2).take_while(|line| line.starts_with('|'));
    let cells = |row: &'static str| row.trim_matches('|').split('|').map(str::trim).collect();
    let rows: Vec<_> = rows.map(cells).collect();
    assert!(!rows.is_empty(), "no table '{head}'");
    rows
}

#[test]
fn the_documented_states_match_the_lifecycle() {
    let table = table("| state | code | accept | reject | complete | fail | abort |");
    let row = |state: State| {
        let after = |event| state.after(event).map_or("-", State::name).to_owned();
        let mut row = vec![state.name().to_owned(), state.code().to_string()];
        row.extend(Event::ALL.into_iter().map(after));
        row
    };
    assert_eq!(table, State::ALL.map(row));
}

#[test]
fn the_documented_request_codes_match_the_code() {
    let table = table("| request | code |");
    let codes: Vec<_> = table.iter().map(|row| (&row[0][..4], row[1])).collect();
    assert_eq!(codes, [("INIT", "1"), ("STAT", "2"), ("ABOR", "3")]);
    for (row, request) in table
        .iter()
        .zip([Request::Init, Request::Status, Request::Abort])
    {
        assert_eq!(row[1], request.code().to_string());
    }
}

#[test]
fn the_documented_times_match_the_code() {
    let config = Config::new(TaskId::new(1).unwrap(), 1);
    assert_eq!(config.hold, HOLD);
    let times = [
        TIMEOUT,
        HOLD,
        LONGEST_WAIT,
        config.early,
        KEEP_INIT,
        config.keep,
    ];
    let table = table("| what | time |");
    let told: Vec<_> = table.iter().map(|row| row[1]).collect();
    assert_eq!(told, times.map(|time| format!("{} ms", time.as_millis())));
    // The values that the text gives in other units.
    assert_eq!((HOLD.as_millis(), KEEP_INIT.as_secs()), (1500, 60));
    assert_eq!(config.keep, Duration::from_secs(3600));

    let nobody = format!("tcp://127.0.0.1:{}", reserve_port());
    let mut remote = RemoteTask::connect(&nobody, "/robot").expect("an address");
    match remote.status(TaskId::new(7).unwrap()) {
        Err(RequestError::NotConnected { waited, .. }) => assert!(waited >= TIMEOUT, "{waited:?}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_documented_sizes_match_the_code() {
    assert_eq!(ztl_std::server::MAX_MESSAGE, 1_048_576);
    assert!(DOCUMENT.contains("1 MiB (1,048,576 bytes)"));
    let digits = format!("up to {} digits", ztl_core::integer::MAX_DIGITS);
    assert!(DOCUMENT.contains(&digits));
}

/// A server with room for next to nothing: two tasks, and two answers to hold.
struct Small(Dispatcher<Fixed<(), 1, 2, 32, 2>>);

impl Small {
    fn new(first: u32) -> Self {
        let config = Config::new(TaskId::new(first).unwrap(), 1);
        Self(Dispatcher::new(Fixed::new(["/lab"]), config))
    }

    /// The answers to an INIT of this client, or of one without an envelope.
    fn init(&mut self, client: Option<u8>) -> Vec<String> {
        let envelope = client.map(|client| Envelope {
            client: ClientId([client; 16]),
            number: 1,
            early_end: false,
        });
        let mut answers = Vec::new();
        let mut out = |(), reply: &Reply<'_>| answers.push(text(reply));
        let body = Body::One(b"/lab;1;-1;x");
        self.0
            .handle_request(Instant::ZERO, (), envelope, body, &mut out);
        answers
    }

    fn accept(&mut self, id: u32) {
        let event = TaskEvent::Accepted { reply: "" };
        let id = TaskId::new(id).unwrap();
        self.0
            .handle_event(Instant::ZERO, id, event, &mut |(), _| {});
    }
}

fn text(reply: &Reply<'_>) -> String {
    let mut text = Vec::new();
    reply.put(&mut |bytes: &[u8]| text.extend_from_slice(bytes));
    String::from_utf8(text).unwrap()
}

#[test]
fn the_document_quotes_a_full_servers_rejections() {
    let mut tasks = Small::new(1);
    let mut held = Small::new(1);
    let mut clients = Small::new(1);
    let mut ids = Small::new(u32::MAX);
    for (id, client) in [(1, 1), (2, 2)] {
        assert!(tasks.init(None).is_empty());
        tasks.accept(id);
        assert!(clients.init(Some(client)).is_empty());
        clients.accept(id);
    }
    assert!(ids.init(None).is_empty());
    // An INIT that is undecided, and the same once more.
    assert!(held.init(Some(1)).is_empty() && held.init(Some(1)).is_empty());
    for (answers, reason) in [
        (
            tasks.init(None),
            "too many tasks are running, wait for one to end",
        ),
        (held.init(None), "too many requests are waiting, try again"),
        (
            clients.init(Some(3)),
            "too many clients at a time, try again in a minute",
        ),
        (
            ids.init(None),
            "all task ids are used up; restart the server, without its journal if it has one",
        ),
    ] {
        assert_eq!(answers, [format!("/lab;2;-1;{reason}")]);
        // Wherever its lines end.
        let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(words(DOCUMENT).contains(&format!("`{reason}`")), "{reason}");
    }
}
