mod ids;

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use ztl_core::link::{LinkId, Loss};

use super::*;
use crate::gateway::parameters::PARAMETERS;
use crate::gateway::updates::UPDATES;
use ztl_link::Sent;

/// 2026-01-01 and some seconds.
fn at(seconds: u64) -> Moment {
    Moment {
        wall: UNIX_EPOCH + Duration::from_secs(1_767_225_600 + seconds),
        running: Duration::from_secs(seconds),
    }
}

fn id(number: u32) -> TaskId {
    TaskId::new(number).unwrap()
}

fn task(number: u32) -> Entry<'static> {
    Entry {
        id: id(number),
        component: "finger",
        goal: "4\u{2028}0\n",
        sent: Some(Sent {
            link: LinkId(number - 100),
            boot: 81501,
            loss: Loss::CarryOn,
            link_timeout: Duration::from_millis(1500),
        }),
    }
}

impl<S: Storage> JournalRecords<S> {
    fn start(&mut self, now: Moment, number: u32) -> Result<(), String> {
        let client = Some("c0ffee".to_owned());
        self.starting(now, "gripper", client, None, &task(number))
    }

    #[track_caller]
    fn complete(&mut self, now: Moment, number: u32, text: &str) {
        let end = (State::Completed, text);
        self.ended_as(now, "gripper", &task(number), end).unwrap();
    }

    fn ids(&self) -> (Vec<u32>, Vec<(u32, String)>) {
        let unended = self.unended();
        let unended = unended.iter().map(|(_, task)| task.id.get()).collect();
        let ended = self.ended(at(0)).into_iter();
        let ended = ended.map(|(_, task)| (task.id.get(), task.text)).collect();
        (unended, ended)
    }
}

/// The next gateway's view of what one has written.
fn again<S: Storage>(written: &[u8], storage: S) -> JournalRecords<S> {
    JournalRecords::open(storage, written, at(100), 99)
}

fn fresh() -> JournalRecords<Vec<u8>> {
    JournalRecords::open(Vec::new(), b"", at(0), 7)
}

fn restarted(log: &JournalRecords<Vec<u8>>) -> JournalRecords<Vec<u8>> {
    let written = log.storage.clone();
    again(&written, written.clone())
}

#[test]
fn the_board_of_a_task_is_known_after_a_restart_until_the_task_has_ended() {
    let mut log = fresh();
    log.starting(at(1), "gripper", None, Some(u64::MAX), &task(101))
        .unwrap();
    log.accepted(at(2), "gripper", &task(101), "").unwrap();
    // Without a shared line, or of a gateway that did not know.
    log.start(at(2), 102).unwrap();
    let next = restarted(&log);
    assert_eq!(next.boards("gripper"), [(81501, u64::MAX)]);
    assert!(next.boards("head").is_empty());
    assert_eq!(next.unended().len(), 2);
    let id = br#""board":"ffffffffffffffff""#;
    let ids = log.storage.windows(id.len()).filter(|part| part == id);
    assert_eq!(ids.count(), 2);
    // A search has found it later.
    log.add_board(at(2), "head", 81501, 5);
    log.add_board(at(2), "gripper", 81502, 6);
    assert_eq!(restarted(&log).boards("gripper"), [(81501, u64::MAX)]);
    log.add_board(at(2), "gripper", 81501, 7);
    let next = restarted(&log);
    assert_eq!(next.boards("gripper"), [(81501, 7), (81501, 7)]);
    assert!(next.unended()[0].1.accepted);
    log.complete(at(3), 101, "40.0");
    log.complete(at(3), 102, "40.0");
    assert!(restarted(&log).boards("gripper").is_empty());
}

#[test]
fn written_entries_are_known_after_a_restart() {
    let mut log = fresh();
    assert_eq!(log.gateway(), 7);
    for number in 101..=104 {
        log.start(at(1), number).unwrap();
    }
    log.accepted(at(2), "gripper", &task(102), "").unwrap();
    log.complete(at(3), 103, "40.0");
    let rejected = (State::Rejected, "busy");
    log.ended_as(at(4), "gripper", &task(104), rejected)
        .unwrap();

    // Rejected at once: no client has its id.
    log.start(at(4), 105).unwrap();
    log.ended_as(at(4), "gripper", &task(105), rejected)
        .unwrap();

    let log = restarted(&log);
    assert_eq!(
        (log.gateway(), log.reserved_ids().given()),
        (7, 1 + FIRST_BLOCK)
    );
    assert_eq!(log.ended(at(13)).len(), 2);
    let unended = log.unended();
    let known = |number, accepted| {
        let task = task(number);
        let restored = Restored {
            id: task.id,
            component: task.component.to_owned(),
            goal: task.goal.to_owned(),
            sent: task.sent.unwrap(),
            accepted,
        };
        ("gripper".to_owned(), restored)
    };
    assert_eq!(unended, [known(101, false), known(102, true)]);
    let ended = log.ended(at(13));
    let (spec, completed) = &ended[0];
    assert_eq!(*spec, ["gripper", "finger", "4\u{2028}0\n"]);
    assert_eq!(completed.ended, Some(Duration::from_secs(10)));
    assert_eq!(
        (completed.state, completed.text.as_str()),
        (State::Completed, "40.0")
    );
    assert_eq!(
        (ended[1].1.state, ended[1].1.text.as_str()),
        (State::Rejected, "busy")
    );
}

#[test]
fn the_entries_match_the_document() {
    let mut log = JournalRecords::open(Vec::new(), b"", at(0), 0x93f0_5c11_e2d4_7a08);
    let mut task = task(620500741);
    task.goal = "40";
    task.sent.as_mut().unwrap().link = LinkId(3);
    task.sent.as_mut().unwrap().loss = Loss::Abort;
    log.starting(at(1), "gripper", Some("00ff".to_owned()), None, &task)
        .unwrap();
    log.accepted(at(1), "gripper", &task, "").unwrap();
    let end = (State::Completed, "40.0");
    log.ended_as(at(2), "gripper", &task, end).unwrap();
    let written = String::from_utf8(log.storage.clone()).unwrap();
    let document = include_str!("../../../../../docs/journal.md");
    let (_, examples) = document.split_once("```json\n").unwrap();
    let (examples, _) = examples.split_once("```").unwrap();
    // Broken for the page's width.
    let examples = examples.replace("\n    ", "");
    let version = format!("\"version\":\"{}\"", ztl_core::VERSION);
    let process = format!("\"process\":{}", std::process::id());
    let examples = examples.replace("\"version\":\"0.1.0\"", &version);
    assert_eq!(written, examples.replace("\"process\":4711", &process));
}

/// Says how much of it a power cut leaves.
#[derive(Debug, Default)]
struct Synced {
    written: Vec<u8>,
    synced: usize,
}

impl Storage for Synced {
    fn add(&mut self, lines: &[u8], sync: bool) -> io::Result<()> {
        self.written.extend_from_slice(lines);
        if sync {
            self.synced = self.written.len();
        }
        Ok(())
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.written.truncate(len as usize);
        Ok(())
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        self.written.clear();
        self.add(lines, true)
    }

    fn place(&self) -> String {
        "on a disk".to_owned()
    }
}

#[test]
fn with_sync_every_entry_with_an_effect_is_synced() {
    let mut log = JournalRecords::open(Synced::default(), b"", at(0), 7).with_sync(true);
    log.start(at(1), 101).unwrap();
    log.complete(at(2), 101, "done");
    log.start(at(3), 102).unwrap();
    let storage = &log.storage;
    assert_eq!(storage.synced, storage.written.len());
    // With its note, the next gateway goes on with an update.
    let update = Entry {
        component: UPDATES,
        sent: None,
        ..task(103)
    };
    log.accepted(at(4), "gripper", &update, "{}").unwrap();
    let storage = &log.storage;
    assert_eq!(storage.synced, storage.written.len());
}

#[test]
fn a_request_that_its_gateway_was_carrying_out_is_known_as_cut_off() {
    let mut log = fresh();
    let requests = [
        (PARAMETERS, "save", "list the parameters"),
        (UPDATES, "status", "before the answer"),
        (UPDATES, "{'run': {}}", "during the update"),
    ];
    for (number, (component, goal, _)) in (101..).zip(requests) {
        let (id, sent) = (id(number), None);
        let entry = Entry {
            id,
            component,
            goal,
            sent,
        };
        log.starting(at(1), "gripper", None, None, &entry).unwrap();
    }
    let (open, ended) = restarted(&log).ids();
    assert_eq!((open.len(), ended.len()), (0, 3));
    for ((_, text), (.., part)) in ended.iter().zip(requests) {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn outcomes_are_carried_over_up_to_the_byte_limit() {
    let mut log = fresh();
    let text = "x".repeat(CARRIED_BYTES / 4);
    log.start(at(0), 101).unwrap();
    for number in 102..107 {
        let (now, task) = (at(u64::from(number)), task(number));
        let end = TaskEntry::new(now, "gripper", None, &task, State::Completed, &text);
        log.note(end);
    }
    log.forget(at(2000));
    let ids: Vec<u32> = log.tasks.keys().map(|id| id.get()).collect();
    assert_eq!(ids, [101, 104, 105, 106]);
}

#[test]
fn a_journaled_outcome_never_changes() {
    let mut log = fresh();
    log.start(at(1), 101).unwrap();
    log.complete(at(2), 101, "first");
    log.complete(at(3), 101, "second");
    log.start(at(4), 101).unwrap();
    assert_eq!(
        restarted(&log).ids(),
        (vec![], vec![(101, "first".to_owned())])
    );
}

#[test]
fn an_outcome_expires_after_an_hour_despite_clock_changes() {
    let mut log = fresh();
    log.start(at(1000), 101).unwrap();
    log.complete(at(2000), 101, "done");
    assert_eq!(log.ended(at(2000 + 3599)).len(), 1);
    assert_eq!(log.ended(at(2000 + 3600)).len(), 0);
    let set_back = log.ended(at(0));
    assert_eq!(set_back[0].1.ended, Some(Duration::ZERO));
    let long_ago = Moment {
        wall: UNIX_EPOCH - Duration::from_secs(1),
        running: Duration::ZERO,
    };
    log.start(long_ago, 102).unwrap();
    let far = Moment {
        wall: SystemTime::now() + Duration::from_secs(300_000_000_000),
        running: Duration::MAX,
    };
    log.start(far, 103).unwrap();
    assert_eq!(restarted(&log).unended().len(), 2);
}

#[test]
fn a_write_torn_at_any_length_keeps_the_earlier_entries() {
    let mut log = fresh();
    log.start(at(1), 101).unwrap();
    log.complete(at(2), 101, "done");
    let before = log.storage.len();
    log.start(at(3), 102).unwrap();
    let whole = log.storage.clone();
    for len in 0..=whole.len() {
        let torn = whole[..len].to_vec();
        let mut log = again(&torn, torn.clone());
        let kept = torn
            .iter()
            .rposition(|byte| *byte == b'\n')
            .map_or(0, |end| end + 1);
        assert_eq!(log.storage[..kept], torn[..kept]);
        if len >= before {
            let unended = if len == whole.len() {
                vec![102]
            } else {
                vec![]
            };
            assert_eq!(log.ids(), (unended, vec![(101, "done".to_owned())]));
        }
        // It is written on, and read again without anything to skip.
        log.start(at(101), 103).unwrap();
        let mut after = restarted(&log);
        assert!(after.ids().0.contains(&103));
        let written = after.storage.clone();
        assert!(
            after.read(&written),
            "{len}: {}",
            String::from_utf8_lossy(&written)
        );
    }
}

#[test]
fn unreadable_entries_are_skipped_and_the_rest_is_used() {
    let mut log = fresh();
    log.start(at(1), 101).unwrap();
    log.start(at(1), 102).unwrap();
    let mut written = b"\n\xff\xfe\0\n{}\n[[[[\n{\"event\":\"ended\"}\n".to_vec();
    written.extend_from_slice(&log.storage);
    written.extend_from_slice("{\"event\":\"start\",\"task\":0}\n".as_bytes());
    written.extend_from_slice("[".repeat(100_000).as_bytes());
    written.push(b'\n');
    let log = again(&written, written.clone());
    assert_eq!((log.gateway(), log.ids().0), (7, vec![101, 102]));
    // A new file was begun, where nothing has to be skipped.
    let written = log.storage.clone();
    assert!(again(&written, written.clone()).read(&written));
}

#[test]
fn entries_of_another_version_are_skipped() {
    let mut log = fresh();
    log.start(at(1), 101).unwrap();
    let ours = String::from_utf8(log.storage.clone()).unwrap();
    let other = ours
        .replace("\"journal\":1", "\"journal\":2")
        .replace("101", "102");
    assert_eq!(again(other.as_bytes(), Vec::new()).ids().0, [0; 0]);
    let both = format!("{other}{ours}");
    assert_eq!(again(both.as_bytes(), Vec::new()).ids().0, [101]);
    let both = format!("{ours}{other}");
    assert_eq!(again(both.as_bytes(), Vec::new()).ids().0, [101]);
}

/// A disk with little room: a write that does not fit is torn.
#[derive(Debug)]
struct Small {
    written: Vec<u8>,
    room: usize,
    whole: usize,
}

impl Small {
    fn new(room: usize) -> Self {
        Self {
            written: Vec::new(),
            room,
            whole: 0,
        }
    }
}

impl Storage for Small {
    fn add(&mut self, lines: &[u8], _needed: bool) -> io::Result<()> {
        self.written.truncate(self.whole);
        let fits = lines
            .len()
            .min(self.room - self.written.len().min(self.room));
        self.written.extend_from_slice(&lines[..fits]);
        if fits < lines.len() {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.whole = self.written.len();
        Ok(())
    }

    fn cut(&mut self, len: u64) -> io::Result<()> {
        self.written.truncate(len as usize);
        self.whole = len as usize;
        Ok(())
    }

    fn replace(&mut self, lines: &[u8]) -> io::Result<()> {
        if lines.len() > self.room {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.written = lines.to_vec();
        self.whole = lines.len();
        Ok(())
    }

    fn place(&self) -> String {
        "on a small disk".to_owned()
    }
}

#[test]
fn a_full_disk_rejects_tasks_until_there_is_room() {
    // With no room at all, some, and room for some tasks.
    for room in (0..1200).step_by(37) {
        let mut log = JournalRecords::open(Small::new(room), b"", at(0), 7);
        let mut taken = Vec::new();
        let mut refused = 0;
        for number in 101..110 {
            match log.start(at(1), number) {
                Ok(()) => taken.push(number),
                Err(reason) => {
                    refused += 1;
                    assert!(reason.starts_with("the journal on a small disk cannot be written: "));
                }
            }
        }
        assert!(refused > 0);
        let written = log.storage.written.clone();
        assert_eq!(again(&written, Vec::new()).ids().0, taken);
        log.storage.room = 100_000;
        log.start(at(2), 120).unwrap();
        taken.push(120);
        let written = log.storage.written.clone();
        let after = again(&written, Vec::new());
        assert_eq!((after.gateway(), after.ids().0), (7, taken));
    }
}

#[test]
fn a_grown_file_is_replaced_by_one_with_the_needed_entries() {
    let mut log = fresh();
    log.start(at(0), 101).unwrap();
    log.accepted(at(0), "gripper", &task(101), "").unwrap();
    let (mut longest, mut seconds) = (0, 0);
    // A task a second, for two and a half hours.
    for number in 102..9_102 {
        seconds += 1;
        log.start(at(seconds), number).unwrap();
        log.complete(at(seconds), number, "done");
        longest = longest.max(log.storage.len());
    }
    // An hour's ends, and what comes until the next file.
    let line = 300;
    assert!(longest < 3600 * line + 2 * ROTATE as usize, "{longest}");
    let log = restarted(&log);
    assert_eq!(log.gateway(), 7);
    let given = log.reserved_ids().given();
    assert!((9_101..9_101 + 2 * BLOCK).contains(&given), "{given}");
    assert_eq!(log.unended().len(), 1);
    assert!(log.unended()[0].1.accepted);
    let ended = log.ended(at(seconds));
    let ids: Vec<u32> = ended.iter().map(|(_, task)| task.id.get()).collect();
    assert_eq!(ids.last(), Some(&9_101));
    assert_eq!(ids.len(), 3600);
}

#[test]
fn outcomes_are_carried_over_up_to_the_servers_limit() {
    let mut log = fresh();
    log.start(at(0), 101).unwrap();
    for number in 102..12_102 {
        log.start(at(1), number).unwrap();
        log.complete(at(u64::from(number) / 10), number, "done");
    }
    log.rotate(at(2000)).unwrap();
    assert_eq!(log.tasks.len(), CARRIED);
    assert_eq!(log.unended().len(), 1);
    assert_eq!(
        log.tasks.keys().nth(1),
        Some(&id(12_102 - CARRIED as u32 + 1))
    );
}

#[test]
fn the_old_file_is_kept_if_no_new_one_can_be_started() {
    let mut log = JournalRecords::open(Small::new(usize::MAX), b"", at(0), 7);
    log.start(at(0), 101).unwrap();
    // As if it were full of what is not needed.
    log.rotate_at = 0;
    log.storage.room = log.len as usize + 1000;
    log.start(at(1), 102).unwrap();
    let written = log.storage.written.clone();
    assert_eq!(again(&written, Vec::new()).ids().0, [101, 102]);
}

#[test]
fn no_bytes_make_the_reader_panic() {
    let mut log = fresh();
    log.start(at(1), 101).unwrap();
    log.complete(at(2), 101, "done");
    log.start(at(3), 102).unwrap();
    let good = log.storage.clone();
    let mut dice = ztl_sim::line::Dice::new(1);
    for _ in 0..3000 {
        let mut bytes = good.clone();
        for _ in 0..=dice.below(4) {
            let place = dice.below(bytes.len() as u64) as usize;
            match dice.below(4) {
                0 => bytes[place] = dice.below(256) as u8,
                1 => bytes.insert(place, b"0123456789\"{}[]:-\n"[dice.below(18) as usize]),
                2 => drop(bytes.remove(place)),
                _ => {
                    let end = place + dice.below((bytes.len() - place) as u64 + 1) as usize;
                    let part = bytes[place..end].to_vec();
                    bytes.extend_from_slice(&part);
                }
            }
        }
        let mut log = again(&bytes, bytes.clone());
        let last = log.reserved_ids().given().max(200);
        if let Some(next) = last.checked_add(1) {
            log.starting(
                at(101),
                "gripper",
                None,
                None,
                &Entry {
                    id: id(next),
                    ..task(200)
                },
            )
            .unwrap();
            let unended = restarted(&log).unended();
            assert!(unended.iter().any(|(_, task)| task.id.get() == next));
        }
    }
}

/// A task that a device has started itself.
fn own_task(number: u32, link: u32) -> Entry<'static> {
    let sent = task(number).sent.map(|sent| Sent {
        link: LinkId::local(link),
        ..sent
    });
    Entry {
        sent,
        ..task(number)
    }
}

#[test]
fn the_last_task_that_a_device_has_started_is_never_forgotten() {
    let mut log = fresh();
    assert_eq!(log.latest_own("gripper"), None);
    for (number, link) in [(101, 1), (102, 2)] {
        let task = own_task(number, link);
        log.starting(at(1), "gripper", None, None, &task).unwrap();
        let end = (State::Completed, "40.0");
        log.ended_as(at(2), "gripper", &task, end).unwrap();
    }
    log.start(at(3), 103).unwrap();
    let late = at(3 + 10 * KEEP.as_secs());
    log.forget(late);
    assert_eq!(
        log.tasks.len(),
        2,
        "the unended one, and the last of the device"
    );
    assert!(
        log.ended(late).is_empty(),
        "clients know nothing of it any more"
    );
    log.rotate(late).unwrap();
    let log = restarted(&log);
    assert_eq!(log.latest_own("gripper"), Some((81501, LinkId::local(2))));
    assert_eq!(log.latest_own("head"), None);
}

#[test]
fn a_task_that_a_device_has_started_runs_after_a_restart() {
    let mut log = fresh();
    log.starting(at(1), "gripper", None, None, &own_task(101, 1))
        .unwrap();
    let unended = restarted(&log).unended();
    assert_eq!(unended[0].1.sent.link, LinkId::local(1));
}
