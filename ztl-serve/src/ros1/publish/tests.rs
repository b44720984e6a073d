use std::sync::atomic::{AtomicBool, Ordering};

use super::super::audience::{Heard, Outlet};
use super::job::{STOP_PAUSE, STOPS};
use super::*;
use crate::kind::{Effect, Job as _, StopReason};

/// A topic without a node.
struct FakeTopic {
    sent: Mutex<Vec<Vec<u8>>>,
    /// What a lost node gets when it is back.
    owed: Mutex<Vec<Vec<u8>>>,
    is_heard: AtomicBool,
    is_behind: AtomicBool,
    is_lost: AtomicBool,
}

impl Outlet for Arc<FakeTopic> {
    fn publish(&self, bytes: Vec<u8>) {
        self.sent.lock().expect("no panic").push(bytes);
    }

    fn look(&self, _: Option<Instant>) -> Heard {
        let is_there = self.is_heard.load(Ordering::Relaxed);
        let lost = self.is_lost.load(Ordering::Relaxed);
        Heard {
            nodes: is_there.then(|| "/base".to_owned()).into_iter().collect(),
            has_all: !self.is_behind.load(Ordering::Relaxed),
            lost: lost.then(|| "/base was disconnected".to_owned()),
        }
    }

    fn publish_when_back(&self, _: Instant, bytes: Vec<u8>) {
        self.owed.lock().expect("no panic").push(bytes);
    }

    fn explain(&self) {}
}

struct Bench {
    now: Instant,
    topic: Arc<FakeTopic>,
    job: PublishJob,
    ended: Option<Outcome>,
}

const GO: u8 = 1;
const STOP: u8 = 0;
const MS: Duration = Duration::from_millis(1);

impl Bench {
    fn new(repeat: Option<(Duration, Duration)>, length: Option<Duration>, is_heard: bool) -> Self {
        let topic = Arc::new(FakeTopic {
            sent: Mutex::default(),
            owed: Mutex::default(),
            is_heard: AtomicBool::new(is_heard),
            is_behind: AtomicBool::new(false),
            is_lost: AtomicBool::new(false),
        });
        let plan = Plan {
            message: vec![GO],
            stop: Some(vec![STOP]),
            repeat,
            length,
            acknowledge: ACKNOWLEDGE,
        };
        let now = Instant::now();
        let outlet = Box::new(Arc::clone(&topic));
        Self {
            now,
            job: PublishJob::new(now, "/cmd_vel", plan, outlet),
            topic,
            ended: None,
        }
    }

    fn call(&mut self, call: impl FnOnce(&mut PublishJob, Instant, &mut Vec<Effect>)) {
        let mut effects = Vec::new();
        call(&mut self.job, self.now, &mut effects);
        for effect in effects {
            if let Effect::End(outcome) = effect {
                assert_eq!(self.ended, None, "it ends once");
                self.ended = Some(outcome);
            }
        }
    }

    fn pass(&mut self, time: Duration) {
        let end = self.now + time;
        while let Some(next) = self.job.poll_timeout().filter(|next| *next <= end) {
            self.now = next.max(self.now);
            self.call(|job, now, effects| job.handle_timeout(now, effects));
        }
        self.now = end;
    }

    fn stop(&mut self, why: StopReason) {
        self.call(|job, now, effects| job.stop(now, why, effects));
    }

    fn sent(&self) -> Vec<u8> {
        self.topic.sent.lock().expect("no panic").concat()
    }
}

/// 10 Hz with a dead-man of 500 ms.
const DRIVE: Option<(Duration, Duration)> = Some((INTERVAL, DEAD_MAN));

#[test]
fn a_drive_of_a_length_ends_with_the_stop_message_five_times() {
    let mut bench = Bench::new(DRIVE, Some(450 * MS), true);
    bench.pass(2000 * MS);
    assert_eq!(
        bench.sent(),
        [GO, GO, GO, GO, GO, STOP, STOP, STOP, STOP, STOP]
    );
    assert_eq!(bench.ended, Some(Outcome::Completed("True".to_owned())));
}

#[test]
fn an_abort_and_the_end_of_the_server_stop_at_once() {
    for (why, text) in [
        (StopReason::Client, "aborted"),
        (StopReason::Server, "the server was stopped"),
    ] {
        let mut bench = Bench::new(DRIVE, None, true);
        bench.pass(250 * MS);
        assert_eq!(bench.sent(), [GO, GO, GO]);
        bench.stop(why);
        assert_eq!(bench.sent(), [GO, GO, GO, STOP]);
        bench.stop(why);
        bench.pass(STOP_PAUSE * STOPS);
        assert_eq!(bench.sent()[3..], [STOP; 5]);
        assert_eq!(bench.ended, Some(Outcome::Aborted(text.to_owned())));
    }
}

#[test]
fn a_pause_longer_than_the_dead_man_stops_the_robot() {
    let mut bench = Bench::new(DRIVE, None, true);
    bench.pass(100 * MS);
    // The process was suspended.
    bench.now += 600 * MS;
    bench.call(|job, now, effects| job.handle_timeout(now, effects));
    assert_eq!(bench.sent(), [GO, GO, STOP]);
    bench.pass(1000 * MS);
    let Some(Outcome::Failed(reason)) = &bench.ended else {
        panic!("{:?}", bench.ended);
    };
    assert!(
        reason.starts_with("no message went out for 600 ms, longer than dead-man: 500 ms"),
        "{reason}"
    );
}

#[test]
fn a_task_needs_a_subscriber_at_its_beginning_and_to_its_end() {
    let mut bench = Bench::new(DRIVE, None, false);
    bench.pass(2000 * MS);
    let reason = "no node subscribes to /cmd_vel within 1500 ms".to_owned();
    assert_eq!(bench.ended, Some(Outcome::Rejected(reason)));
    assert!(bench.sent().is_empty());
    let mut bench = Bench::new(DRIVE, None, false);
    bench.pass(200 * MS);
    bench.topic.is_heard.store(true, Ordering::Relaxed);
    bench.pass(300 * MS);
    bench.topic.is_heard.store(false, Ordering::Relaxed);
    bench.pass(1000 * MS);
    let reason = "no node subscribes to /cmd_vel any more".to_owned();
    assert_eq!(bench.ended, Some(Outcome::Unknown(reason)));
    assert!(bench.sent().ends_with(&[STOP; 5]), "{:?}", bench.sent());
    let mut bench = Bench::new(DRIVE, None, false);
    bench.stop(StopReason::Client);
    let text = "aborted before it began".to_owned();
    assert_eq!(bench.ended, Some(Outcome::Aborted(text)));
    assert!(bench.sent().is_empty());
}

#[test]
fn without_a_rate_the_message_goes_out_once() {
    let mut bench = Bench::new(None, None, true);
    bench.pass(1000 * MS);
    assert_eq!(bench.sent(), [GO, STOP, STOP, STOP, STOP, STOP]);
    assert_eq!(bench.ended, Some(Outcome::Completed("True".to_owned())));
}

#[test]
fn a_task_ends_as_completed_only_after_its_last_message_is_acknowledged() {
    for repeat in [DRIVE, None] {
        let mut bench = Bench::new(repeat, Some(200 * MS), true);
        bench.topic.is_behind.store(true, Ordering::Relaxed);
        bench.pass(900 * MS);
        assert_eq!(bench.ended, None);
        bench.topic.is_behind.store(false, Ordering::Relaxed);
        bench.pass(10 * MS);
        assert_eq!(bench.ended, Some(Outcome::Completed("True".to_owned())));

        let mut bench = Bench::new(repeat, Some(200 * MS), true);
        bench.topic.is_behind.store(true, Ordering::Relaxed);
        bench.pass(3000 * MS);
        let reason = "a node that subscribes to /cmd_vel has not acknowledged the last message";
        assert_eq!(bench.ended, Some(Outcome::Unknown(reason.to_owned())));
    }
}

#[test]
fn a_node_that_was_disconnected_makes_the_outcome_unknown_also_of_an_abort() {
    let lost = Outcome::Unknown("/base was disconnected".to_owned());
    let mut bench = Bench::new(DRIVE, None, true);
    bench.pass(100 * MS);
    bench.topic.is_lost.store(true, Ordering::Relaxed);
    bench.pass(500 * MS);
    assert_eq!(bench.ended, Some(lost.clone()));
    // It is stopped when it is back.
    assert_eq!(*bench.topic.owed.lock().expect("no panic"), [[STOP]]);
    let mut bench = Bench::new(DRIVE, None, true);
    bench.pass(100 * MS);
    bench.topic.is_behind.store(true, Ordering::Relaxed);
    bench.stop(StopReason::Client);
    bench.pass(100 * MS);
    bench.topic.is_lost.store(true, Ordering::Relaxed);
    bench.pass(500 * MS);
    assert_eq!(bench.ended, Some(lost));
}
