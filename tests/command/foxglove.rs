//! Foxglove reads recordings: with its own reader and its own schemas, in Node.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant, UNIX_EPOCH};

use serde_json::Value;
use ztl_pickle::Pickle;
use ztl_record::{Formats, Message, Recording, SoundFormat, Source, Written};
use ztl_tests::lab::{Process, Scratch, javascript_packages};

/// The messages that Foxglove's reader finds.
#[track_caller]
fn read_by_foxglove(file: &Path) -> Vec<Value> {
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("peers/foxglove.mjs");
    let mut node = Command::new("node");
    node.env("ZTL_CLIENTS", javascript_packages())
        .arg(script)
        .arg(file);
    let ended = Process::run(&mut node);
    assert_eq!(ended.code, Some(0), "{ended:?}");
    let lines = ended.stdout.lines();
    lines
        .map(|line| serde_json::from_str(line).expect("JSON"))
        .collect()
}

#[test]
fn foxglove_reads_values_images_sound_tasks_and_runs() {
    let scratch = Scratch::new();
    let file = scratch.path("run.mcap");
    let robot = Source::named("robot");
    let mut formats = Formats::default();
    let (rate, channels) = (8000, 2);
    formats.set_sound("/lab/microphone/", SoundFormat { rate, channels });
    let jpeg = [b"\xff\xd8\xff\xe0".as_slice(), &[7; 300]].concat();
    let task = [("state", "INITIATED"), ("payload", "move")];
    let task = task.map(|(key, text)| (key, Pickle::text(text).expect("text")));
    let task = task.into_iter().chain([("id", 7.into())]);
    let pose = [("x", 1.5), ("time", 1_700_000_000.5)];
    let bodies = [
        ("/lab/battery/", Pickle::from(12.5)),
        ("/lab/pose/", Pickle::dict(pose).expect("a dict")),
        ("/lab/camera/", Pickle::bytes(&jpeg).expect("bytes")),
        // 10 ms.
        ("/lab/microphone/", Pickle::bytes(&[1; 320]).expect("bytes")),
        ("/lab/$tasks/7", Pickle::dict(task).expect("a dict")),
    ];
    let mut recording = Recording::create(&file).expect("a file");
    let start = Instant::now();
    for nth in 0..20 {
        let at = start + Duration::from_millis(100) * nth;
        for (topic, value) in &bodies {
            let message = formats.prepare(&robot, topic, &value.to_bytes());
            let written = recording.write(&robot, message.expect("a message"), at);
            assert_eq!(written.expect("room"), Written::Yes);
        }
        recording.flush().expect("room");
    }
    let event = br#"{"at_ms":0.1,"wall":"2026-11-21T19:03:40.544307Z","event":"resumed"}"#;
    let message = Message::of_run(event.to_vec(), UNIX_EPOCH + Duration::from_secs(1));
    let written = recording.write(&robot, message, start + Duration::from_secs(9));
    assert_eq!(written.expect("room"), Written::Yes);
    recording.finish().expect("room");

    let messages = read_by_foxglove(&file);
    assert_eq!(messages.len(), 20 * bodies.len() + 1);
    let number = |value: &Value| value.as_str().expect("a time").parse::<u64>().expect("one");
    let (first, later) = (&messages[..bodies.len()], &messages[bodies.len()]);
    let passed = number(&later["log"]) - number(&first[0]["log"]);
    assert_eq!(passed, 100_000_000);
    let of = |topic: &str| {
        let found = messages.iter().find(|message| message["topic"] == topic);
        found.unwrap_or_else(|| panic!("no {topic}"))
    };
    let stamp = |message: &Value| {
        let stamp = &message["value"]["timestamp"];
        let part = |name| stamp[name].as_u64().expect("a number");
        part("sec") * 1_000_000_000 + part("nsec")
    };
    assert_eq!(of("/lab/battery/")["value"]["value"], 12.5);
    let pose = of("/lab/pose/");
    assert_eq!(
        (&pose["value"]["value"]["x"], &pose["schema"]),
        (&1.5.into(), &"ztl.Value".into())
    );
    assert_eq!(number(&pose["publish"]), 1_700_000_000_500_000_000);
    let image = of("/lab/camera/");
    assert_eq!(image["schema"], "foxglove.CompressedImage");
    assert_eq!(stamp(image), number(&image["log"]));
    assert_eq!(
        (&image["value"]["format"], &image["value"]["frame_id"]),
        (&"jpeg".into(), &"".into())
    );
    let start_of_jpeg = image["value"]["data"].as_str().expect("base64");
    assert!(start_of_jpeg.starts_with("/9j/4AcHBwcH"), "{start_of_jpeg}");
    let sound = of("/lab/microphone/");
    assert_eq!(sound["schema"], "foxglove.RawAudio");
    // The time of its first sample.
    assert_eq!(stamp(sound), number(&sound["log"]) - 10_000_000);
    let task = of("/lab/$tasks");
    assert_eq!(
        (&task["schema"], &task["value"]["id"]),
        (&"ztl.TaskEvent".into(), &7.into())
    );
    let run = of("/$run");
    assert_eq!(
        (&run["schema"], &run["value"]["event"]),
        (&"ztl.RunEvent".into(), &"resumed".into())
    );
    assert_eq!(number(&run["publish"]), 1_000_000_000);
}
