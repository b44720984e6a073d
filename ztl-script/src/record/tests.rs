use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use super::*;
use crate::event::RunOutcome;

/// A disk with so much room left, and what stands on it.
#[derive(Clone, Default)]
struct Disk(Arc<Mutex<(usize, Vec<u8>)>>);

impl Disk {
    fn give(&self, room: usize) {
        self.0.lock().unwrap().0 = room;
    }

    fn text(&self) -> String {
        String::from_utf8(self.0.lock().unwrap().1.clone()).unwrap()
    }
}

impl Write for Disk {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let (room, text) = &mut *self.0.lock().unwrap();
        let count = bytes.len().min(*room);
        if count == 0 {
            return Err(ErrorKind::StorageFull.into());
        }
        *room -= count;
        text.extend_from_slice(&bytes[..count]);
        Ok(count)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Target for Disk {}

fn note(millis: u64, text: &str) -> StampedEvent {
    StampedEvent {
        at: Duration::from_millis(millis),
        wall: SystemTime::UNIX_EPOCH + Duration::from_millis(millis),
        event: RunEvent::Note {
            text: text.to_owned(),
        },
    }
}

/// The texts of the notes in what was written, and what is wrong with it.
fn notes(text: &str) -> (Vec<String>, Vec<String>) {
    let started = include_str!("../fixtures/evening.jsonl");
    let first = started.lines().next().unwrap();
    let (runs, damage) = read("run.jsonl", format!("{first}\n{text}").as_bytes()).unwrap();
    let texts = runs[0]
        .events
        .iter()
        .filter_map(|event| match &event.event {
            RunEvent::Note { text } => Some(text.clone()),
            _ => None,
        });
    let damage = damage.iter().map(ToString::to_string).collect();
    (texts.collect(), damage)
}

#[test]
fn a_full_disk_is_reported_once_and_the_record_counts_lost_events() {
    let disk = Disk::default();
    let mut recorder = Recorder::new(disk.clone(), "run.jsonl".to_owned());
    disk.give(10_000);
    recorder.write(&note(1, "before")).unwrap();
    disk.give(20);
    let told = recorder.write(&note(2, "lost")).unwrap_err().to_string();
    assert!(
        told.starts_with("the record run.jsonl cannot be written: "),
        "{told}"
    );
    recorder.write(&note(3, "lost too")).unwrap();
    disk.give(10_000);
    recorder.write(&note(4, "after")).unwrap();

    let (texts, damage) = notes(&disk.text());
    assert_eq!(
        texts,
        ["before", "2 events are lacking in the record here", "after"]
    );
    // A truncated line does not spoil the next one.
    assert!(
        damage[0].starts_with("run.jsonl:3: no event: "),
        "{damage:?}"
    );
    assert_eq!(damage.len(), 2, "{damage:?}");
}

#[test]
fn a_full_disk_is_reported_again_only_after_a_written_event() {
    let disk = Disk::default();
    let mut recorder = Recorder::new(disk.clone(), "run.jsonl".to_owned());
    assert!(recorder.write(&note(1, "a")).is_err());
    for millis in 2..10 {
        // Room for what says how many are lacking, and for nothing else.
        disk.give(140);
        recorder.write(&note(millis, &"b".repeat(200))).unwrap();
    }
    disk.give(10_000);
    recorder.write(&note(10, "c")).unwrap();
    disk.give(0);
    assert!(recorder.write(&note(11, "d")).is_err());
}

#[test]
fn an_existing_record_is_not_overwritten() {
    let file = std::env::temp_dir().join(format!("ztl-record-{}.jsonl", std::process::id()));
    let _ = std::fs::remove_file(&file);
    let mut recorder = Recorder::create(&file).unwrap();
    recorder.write(&note(1, "kept")).unwrap();
    let error = Recorder::create(&file).unwrap_err().to_string();
    let kept = std::fs::read_to_string(&file).unwrap();
    std::fs::remove_file(&file).unwrap();
    assert!(
        error.contains("exists, and a record is not overwritten"),
        "{error}"
    );
    assert!(kept.ends_with("\"text\":\"kept\"}\n"), "{kept}");
}

#[test]
fn a_record_cut_anywhere_is_read_up_to_the_cut() {
    let whole = include_bytes!("../fixtures/evening.jsonl");
    let (runs, damage) = read("run.jsonl", &whole[..]).unwrap();
    assert_eq!(damage, []);
    let events = runs[0].events.len();
    for cut in (0..whole.len()).step_by(101) {
        let (runs, damage) = read("run.jsonl", &whole[..cut]).unwrap();
        let lines = whole[..cut].iter().filter(|byte| **byte == b'\n').count();
        // A last line that lacks only its end of line is whole.
        let more = usize::from(whole[cut] == b'\n');
        let read: usize = runs.iter().map(|run| run.events.len()).sum();
        assert_eq!(read, (lines + more).min(events), "cut at {cut}");
        assert!(!damage.is_empty() || lines + more == events, "cut at {cut}");
    }
}

#[test]
fn a_line_without_an_event_is_skipped_and_reported_with_its_number() {
    let text = include_str!("../fixtures/evening.jsonl");
    let mut lines: Vec<&str> = text.lines().collect();
    lines.insert(2, "{\"at_ms\":\"soon\"}");
    lines.insert(4, "");
    lines.insert(
        5,
        r#"{"at_ms":0,"wall":"2025-11-21T16:00:00Z","event":"eclipse"}"#,
    );
    let (runs, damage) = read("run.jsonl", lines.join("\n").as_bytes()).unwrap();
    assert_eq!(runs[0].events.len(), text.lines().count());
    let damage: Vec<String> = damage.iter().map(ToString::to_string).collect();
    assert_eq!(damage.len(), 2, "{damage:?}");
    assert!(
        damage[0].starts_with("run.jsonl:3: no event: "),
        "{damage:?}"
    );
    assert_eq!(
        damage[1],
        "run.jsonl:6: an event that only a newer version knows; it is passed over"
    );
}

#[test]
fn an_invalid_record_is_reported_in_a_bounded_list() {
    let (runs, damage) = read("movie.mp4", &b"\xff\xfe\n".repeat(10_000)[..]).unwrap();
    assert_eq!(runs, []);
    assert_eq!(damage.len(), MOST + 1);
    assert_eq!(
        damage[0].to_string(),
        "movie.mp4:1: no event: not UTF-8; the line is passed over"
    );
    assert!(
        damage[MOST].text.starts_with("9900 more"),
        "{}",
        damage[MOST]
    );
    let (_, damage) = read("empty.jsonl", &b""[..]).unwrap();
    assert_eq!(damage[0].to_string(), "empty.jsonl:1: the file is empty");
}

#[test]
fn joined_records_are_read_as_several_runs() {
    let text = include_str!("../fixtures/evening.jsonl");
    let (runs, damage) = read("all.jsonl", format!("{text}{text}").as_bytes()).unwrap();
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    assert_eq!((names, damage), (vec!["all.jsonl", "all.jsonl#2"], vec![]));
    let last = &runs[1].events.last().unwrap().event;
    assert!(
        matches!(
            last,
            RunEvent::RunEnded {
                outcome: RunOutcome::Stopped,
                ..
            }
        ),
        "{last:?}"
    );
}

#[test]
fn that_a_run_goes_on_is_no_damage() {
    let all = include_str!("../fixtures/evening.jsonl");
    let lines: Vec<&str> = all.lines().take(20).collect();
    let cut = format!("{}\n{{\"at_ms\":1", lines.join("\n"));
    let (runs, damage) = read_so_far("run.jsonl", cut.as_bytes()).unwrap();
    assert_eq!((runs.len(), damage), (1, Vec::new()));
    assert_eq!(runs[0].events.len(), lines.len());
    // Of two runs in a file, the first has ended.
    let two = format!("{}\n{cut}", lines.join("\n"));
    let (runs, damage) = read_so_far("run.jsonl", two.as_bytes()).unwrap();
    let texts: Vec<&str> = damage.iter().map(|damage| damage.text.as_str()).collect();
    let lack = "the end of run.jsonl is lacking: it is read as far as it goes";
    assert_eq!((runs.len(), texts), (2, vec![lack]));
    let (_, damage) = read_so_far("run.jsonl", &b"nonsense\n"[..]).unwrap();
    assert_eq!(damage.len(), 1, "{damage:?}");
}

#[cfg(unix)]
#[test]
fn the_operator_is_told_once_that_the_record_was_deleted() {
    let file = std::env::temp_dir().join(format!("ztl-deleted-{}.jsonl", std::process::id()));
    let _ = std::fs::remove_file(&file);
    let mut recorder = Recorder::create(&file).unwrap();
    recorder.write(&note(1, "kept")).unwrap();
    std::fs::remove_file(&file).unwrap();
    let error = recorder.write(&note(2, "lost")).unwrap_err().to_string();
    assert!(
        error.contains("cannot be written: it was deleted"),
        "{error}"
    );
    recorder.write(&note(3, "lost")).unwrap();
}
