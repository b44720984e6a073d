//! The memory of a recorder does not grow with the length of its recording. A process of its own, to be measured.

use std::time::{Duration, Instant};

use ztl_record::{Formats, Recording, Source, Written};
use ztl_tests::lab::{Scratch, process_status};

/// Chunks of a recording, and topics in each. A recorder writes one each 0.3 s: 24 hours have 288,000.
const CHUNKS: u32 = 6000;
const TOPICS: usize = 50;

#[test]
fn an_index_of_many_chunks_and_topics_takes_no_memory() {
    let scratch = Scratch::new();
    let path = scratch.path("run.mcap");
    let robot = Source::named("robot");
    let formats = Formats::default();
    let topics: Vec<String> = (0..TOPICS).map(|nth| format!("/lab/{nth}")).collect();
    let memory = || process_status(std::process::id(), "VmHWM:");
    let mut recording = Recording::create(&path).expect("a file");
    let start = Instant::now();
    let mut at_first = 0;
    for chunk in 0..CHUNKS {
        for topic in &topics {
            let message = formats.prepare(&robot, topic, b"x").expect("a message");
            let at = start + Duration::from_millis(300) * chunk;
            let written = recording.write(&robot, message, at).expect("room");
            assert_eq!(written, Written::Yes);
        }
        recording.flush().expect("room");
        if chunk == CHUNKS / 10 {
            at_first = memory();
        }
    }
    recording.finish().expect("room");
    let grown = memory() - at_first;
    // The crate `mcap` would have taken more than 2 KiB for each chunk.
    assert!(grown < 2048, "{grown} KiB for {CHUNKS} chunks");
}
