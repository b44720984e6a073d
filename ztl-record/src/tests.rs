//! Recordings: what is written is read again, and what is damaged harms no reader.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use ztl_pickle::Pickle;
use ztl_tests::lab::{Random, Scratch, seed};

use crate::{Content, Drawn, Formats, Read, Reader, Recording, SoundFormat, Source, Written};

/// What numpy 2 writes for `numpy.array([1, 2], dtype="u1")`, and other values that JSON cannot tell.
fn values() -> Vec<Vec<u8>> {
    let pickles = [
        Pickle::none(),
        12.5.into(),
        (-0.0).into(),
        0.1.into(),
        f64::NAN.into(),
        f64::INFINITY.into(),
        i64::MIN.into(),
        u64::MAX.into(),
        true.into(),
        Pickle::text("Grüße \u{1f916}\n").expect("text"),
        Pickle::tuple([Pickle::from(1), 2.5.into()]).expect("a tuple"),
        Pickle::list([Pickle::bytes(b"\0\xff").expect("bytes")]).expect("a list"),
        Pickle::dict([("x", Pickle::from(1.0)), ("time", 1_700_000_000.25.into())])
            .expect("a dict"),
        Pickle::dict([(1, 2)]).expect("a dict"),
        Pickle::set([1, 2]).expect("a set"),
        Pickle::text(&"long".repeat(20_000)).expect("text"),
        Pickle::bytes(b"\xff\xd8\xff\xe0 an image").expect("bytes"),
        Pickle::bytes(b"bytes").expect("bytes"),
    ];
    let mut values: Vec<_> = pickles.iter().map(Pickle::to_bytes).collect();
    values.push(b"12.5 V".to_vec());
    values.push(b"\xff\xd8\xff\xe0 an image, raw".to_vec());
    values.push(b"\xfe\xff bytes, raw".to_vec());
    values
}

fn robot() -> Source {
    Source {
        name: "robot".to_owned(),
        endpoint: "tcp://robot:6000".to_owned(),
        key: String::new(),
    }
}

fn formats() -> Formats {
    let mut formats = Formats::default();
    let format = SoundFormat {
        rate: 16000,
        channels: 1,
    };
    formats.set_sound("/lab/microphone", format);
    formats
}

fn event(state: &str, more: &[(&str, &str)]) -> Vec<u8> {
    let mut fields = vec![("id", Pickle::from(7)), ("time", 1_700_000_000.5.into())];
    let texts = [("state", state)].into_iter().chain(more.iter().copied());
    fields.extend(texts.map(|(key, text)| (key, Pickle::text(text).expect("text"))));
    Pickle::dict(fields).expect("a dict").to_bytes()
}

/// Topics and bodies of a small recording.
fn messages() -> Vec<(String, Vec<u8>)> {
    let asked = [("handler", "head"), ("component", "pan"), ("goal", "<b>")];
    let mut messages = vec![
        ("/lab/$tasks/7".to_owned(), event("INITIATED", &asked)),
        (
            "/lab/$tasks/7".to_owned(),
            event("ACCEPTED", &[("text", "31.5")]),
        ),
        (
            "/lab/$tasks/7".to_owned(),
            event("COMPLETED", &[("text", "63")]),
        ),
        // Not the event of task 8, so it is a value.
        ("/lab/$tasks/8".to_owned(), event("INITIATED", &asked)),
        (
            "/lab/microphone".to_owned(),
            Pickle::bytes(&[1, 2, 3, 4]).expect("bytes").to_bytes(),
        ),
    ];
    let values = values().into_iter().enumerate();
    messages.extend(values.map(|(nth, body)| (format!("/lab/{nth}/"), body)));
    messages
}

/// Writes the messages, a millisecond apart.
fn recording(path: PathBuf) -> Vec<(String, Vec<u8>)> {
    let mut recording = Recording::create(&path).expect("a file");
    let start = Instant::now();
    let messages = messages();
    for (nth, (topic, body)) in messages.iter().enumerate() {
        let message = formats().prepare(&robot(), topic, body).expect("a message");
        let at = start + Duration::from_millis(nth as u64);
        let written = recording.write(&robot(), message, at).expect("room");
        assert_eq!(written, Written::Yes);
        if nth % 5 == 0 {
            recording.flush().expect("room");
        }
    }
    recording.finish().expect("room");
    messages
}

/// Whether two bodies are the same to a subscriber.
fn same(one: &[u8], other: &[u8]) -> bool {
    let shown = |body: &[u8]| match Pickle::read(body) {
        Ok(pickle) => pickle.value().repr().to_string(),
        Err(_) => format!("{body:?}"),
    };
    shown(one) == shown(other)
}

#[test]
fn what_is_recorded_is_read_again_at_its_times() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let messages = recording(path.clone());
    let mut reader = Reader::open(&path).expect("a file");
    let read: Vec<Read> = reader.by_ref().collect();
    assert!(!reader.damage().is_any(), "{}", reader.damage());
    assert_eq!(read.len(), messages.len());
    for (read, (topic, body)) in read.iter().zip(&messages) {
        assert_eq!(&read.topic, topic);
        assert_eq!(*read.source, robot());
        assert!(same(&read.body(), body), "{topic}: {read:?}");
    }
    let steps = read
        .windows(2)
        .map(|pair| pair[1].log_time - pair[0].log_time);
    assert!(
        steps.clone().all(|step| step == 1_000_000),
        "{:?}",
        steps.collect::<Vec<_>>()
    );
    // The time in the value, of an event and of a dict.
    let made: Vec<u64> = read
        .iter()
        .filter(|read| read.publish_time != read.log_time)
        .map(|read| read.publish_time)
        .collect();
    let half = 1_700_000_000_500_000_000;
    assert_eq!(made, [half, half, half, half, 1_700_000_000_250_000_000]);
    let tasks = read
        .iter()
        .filter(|read| matches!(read.content, Content::Task(..)));
    assert_eq!(tasks.count(), 3);
    let images = read
        .iter()
        .filter(|read| matches!(read.content, Content::Image(_)));
    assert_eq!(images.count(), 2);
    let sounds = read.iter().filter(|read| matches!(&read.content, Content::Sound(format, data) if format.rate == 16000 && data == &[1, 2, 3, 4]));
    assert_eq!(sounds.count(), 1);
}

#[test]
fn a_pickle_that_would_run_code_is_refused() {
    let body = b"cos\nsystem\n(S'reboot'\ntR.";
    let error = Formats::default()
        .prepare(&robot(), "/lab/", body)
        .unwrap_err();
    assert_eq!(error.to_string(), "refused: os.system");
}

#[test]
fn times_never_go_backwards() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let mut recording = Recording::create(&path).expect("a file");
    let later = Instant::now() + Duration::from_secs(1);
    let message = formats()
        .prepare(&robot(), "/lab/", b"x")
        .expect("a message");
    for at in [later, later - Duration::from_millis(300), later] {
        recording
            .write(&robot(), message.clone(), at)
            .expect("room");
    }
    recording.finish().expect("room");
    let times: Vec<u64> = Reader::open(&path)
        .expect("a file")
        .map(|read| read.log_time)
        .collect();
    assert!(times.is_sorted(), "{times:?}");
}

#[test]
fn a_recording_is_never_overwritten() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    recording(path.clone());
    let before = std::fs::read(&path).expect("a file");
    let error = Recording::create(&path).err().expect("refused").to_string();
    assert!(error.contains("not overwritten"), "{error}");
    assert_eq!(std::fs::read(&path).expect("a file"), before);
}

#[test]
fn a_publisher_with_ever_new_topics_takes_bounded_memory() {
    let scratch = Scratch::new();
    let mut recording = Recording::create(&scratch.path("run.mcap")).expect("a file");
    let mut refused = 0;
    for nth in 0..5000 {
        let message = formats()
            .prepare(&robot(), &format!("/lab/{nth}"), b"x")
            .expect("a message");
        let written = recording
            .write(&robot(), message, Instant::now())
            .expect("room");
        refused += usize::from(written == Written::TooManyTopics);
    }
    assert_eq!((recording.topics(), refused), (4096, 904));
}

#[test]
fn a_publisher_with_long_topics_takes_bounded_memory() {
    let scratch = Scratch::new();
    let mut recording = Recording::create(&scratch.path("run.mcap")).expect("a file");
    let mut written = |topic: String| {
        let message = formats()
            .prepare(&robot(), &topic, b"x")
            .expect("a message");
        let written = recording.write(&robot(), message, Instant::now());
        written.expect("room")
    };
    let long = "x".repeat(300_000);
    for nth in 0..3 {
        assert_eq!(written(format!("/{nth}{long}")), Written::Yes);
    }
    assert_eq!(written(format!("/3{long}")), Written::TooManyTopics);
    assert_eq!(written("/short".to_owned()), Written::Yes);
    assert_eq!(written(format!("/0{long}")), Written::Yes);
}

/// The index that a recording has is the one that its chunks need: the crate `mcap` finds each message by it.
#[test]
fn the_index_finds_every_message() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let messages = recording(path.clone());
    let bytes = std::fs::read(&path).expect("a file");
    let summary = mcap::Summary::read(&bytes).expect("an index").expect("one");
    let stats = summary.stats.as_ref().expect("statistics");
    assert_eq!(stats.message_count, messages.len() as u64);
    assert_eq!(stats.chunk_count as usize, summary.chunk_indexes.len());
    assert!(summary.chunk_indexes.len() > 3);
    assert_eq!(stats.channel_count as usize, summary.channels.len());
    let mut found = 0;
    for chunk in &summary.chunk_indexes {
        let indexes = summary
            .read_message_indexes(&bytes, chunk)
            .expect("indexes");
        for entry in indexes.values().flatten() {
            let message = summary
                .seek_message(&bytes, chunk, entry)
                .expect("a message");
            assert_eq!(message.log_time, entry.log_time);
            found += 1;
        }
    }
    assert_eq!(found, messages.len());
    // Also with all checksums.
    let all = mcap::MessageStream::new(&bytes).expect("a file");
    assert_eq!(all.filter(Result::is_ok).count(), found);
}

#[test]
fn only_the_publisher_of_its_server_tells_of_a_task() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let camera = Source {
        name: "camera".to_owned(),
        endpoint: "tcp://camera:6000".to_owned(),
        key: "a key".to_owned(),
    };
    let mut formats = formats();
    formats.set_teller("/lab", &robot().endpoint);
    let mut recording = Recording::create(&path).expect("a file");
    let told = event("INITIATED", &[("payload", "move")]);
    for (source, topic, foreign) in [
        (&robot(), "/lab/$tasks/7", false),
        (&camera, "/lab/$tasks/7", true),
        // Nobody is known to tell of it.
        (&camera, "/other/$tasks/7", false),
    ] {
        let message = formats.prepare(source, topic, &told).expect("a message");
        assert_eq!(message.is_foreign_event(), foreign, "{topic}");
        let written = recording.write(source, message, Instant::now());
        assert_eq!(written.expect("room"), Written::Yes);
    }
    recording.finish().expect("room");
    let read: Vec<Read> = Reader::open(&path).expect("a file").collect();
    let told: Vec<_> = read
        .iter()
        .map(|read| (&*read.source, matches!(read.content, Content::Task(..))))
        .collect();
    assert_eq!(told, [(&robot(), true), (&camera, false), (&camera, true)]);
    // It is replayed as it was heard.
    assert!(read.iter().all(|one| same(&one.body(), &read[0].body())));
}

#[test]
fn a_recording_that_is_cut_anywhere_is_read_up_to_there() {
    let scratch = Scratch::new();
    let (path, cut) = (scratch.path("run.mcap"), scratch.path("cut.mcap"));
    recording(path.clone());
    let bytes = std::fs::read(&path).expect("a file");
    let all: Vec<String> = Reader::open(&path)
        .expect("a file")
        .map(|read| read.topic)
        .collect();
    let mut random = Random::new(seed());
    let mut most = 0;
    for _ in 0..200 {
        let length = random.below(bytes.len());
        std::fs::write(&cut, &bytes[..length]).expect("a file");
        let mut reader = Reader::open(&cut).expect("a file");
        let topics: Vec<String> = reader.by_ref().map(|read| read.topic).collect();
        assert!(all.starts_with(&topics), "{length}: {topics:?}");
        // Behind the last message there is only the index.
        assert!(
            reader.damage().end.is_some() || topics.len() == all.len(),
            "{length}"
        );
        most = most.max(topics.len());
    }
    assert!(most > 5, "only {most} messages");
}

/// The recording without the checksums of its chunks, so that damage in messages is found by what reads them.
fn without_checksums(whole: &[u8]) -> Vec<u8> {
    let mut bytes = whole.to_vec();
    let mut place = 8;
    let mut chunks = 0;
    while let Some(length) = bytes.get(place + 1..place + 9) {
        let length = u64::from_le_bytes(length.try_into().expect("8 bytes")) as usize;
        if bytes[place] == 6 {
            bytes[place + 33..place + 37].fill(0);
            chunks += 1;
        }
        place += 9 + length;
    }
    assert!(chunks > 3, "{chunks}");
    bytes
}

#[test]
fn damaged_recordings_harm_neither_reader_nor_report() {
    let scratch = Scratch::new();
    let (path, damaged) = (scratch.path("run.mcap"), scratch.path("damaged.mcap"));
    recording(path.clone());
    let whole = std::fs::read(&path).expect("a file");
    let unchecked = without_checksums(&whole);
    let mut random = Random::new(seed());
    for nth in 0..500 {
        let mut bytes = [&whole, &unchecked][nth % 2].clone();
        for _ in 0..=random.below(8) {
            let place = random.below(bytes.len().min(20_000));
            match random.below(3) {
                0 => bytes[place] ^= 1 << random.below(8),
                1 => bytes[place] = 0xff,
                _ => {
                    let number = random.bits().to_le_bytes();
                    let end = (place + 8).min(bytes.len());
                    bytes[place..end].copy_from_slice(&number[..end - place]);
                }
            }
        }
        std::fs::write(&damaged, &bytes).expect("a file");
        for read in Reader::open(&damaged).expect("a file") {
            let _ = read.body();
        }
        // An error if nothing is readable.
        let _ = Drawn::read(&damaged).map(|drawn| drawn.page());
    }
}

#[test]
fn a_damaged_chunk_is_left_out_and_the_next_one_is_read() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let messages = recording(path.clone());
    let mut bytes = std::fs::read(&path).expect("a file");
    let place = bytes
        .windows(4)
        .position(|part| part == b"31.5")
        .expect("a task's progress");
    bytes[place] = b'9';
    std::fs::write(&path, bytes).expect("a file");
    let mut reader = Reader::open(&path).expect("a file");
    let read = reader.by_ref().count();
    assert_eq!(reader.damage().chunks, 1);
    assert!(read > 0 && read < messages.len(), "{read}");
    let shown = reader.damage().to_string();
    assert!(
        shown.starts_with("1 damaged chunks are left out"),
        "{shown}"
    );
}

#[test]
fn a_report_draws_streams_above_tasks_and_escapes_them() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    recording(path.clone());
    let drawn = Drawn::read(&path).expect("a page");
    assert!(!drawn.damage.is_any(), "{}", drawn.damage);
    let html = drawn.page();
    let place = |part: &str| {
        html.find(part)
            .unwrap_or_else(|| panic!("no {part}: {html}"))
    };
    let stream = place("<path class=\"series s0\"");
    assert!(stream < place("data-task=\"7\""));
    place("<path class=\"wave\"");
    place(
        "<image id=\"image-0-1\" width=\"84\" height=\"63\" preserveAspectRatio=\"xMinYMid\" href=\"data:image/jpeg;base64,/9j/",
    );
    place("head:pan:&lt;b&gt;");
    assert!(!html.contains("<b>"));
    assert!(!html.contains("<script"));
}
