//! Gateways that are killed and started again on what they have written down.

use super::*;

impl Pair {
    /// The gateway is killed and started again; what is on the line stays there.
    pub(super) fn restart(&mut self, dice: &mut Dice) {
        self.note("gateway killed and started again".to_owned());
        // It may die while it writes a line, from which nothing has followed then.
        let torn = &b"{\"event\":\"start\",\"task\":1"[..dice.below(25) as usize];
        self.disk.tear(torn);
        let disk = self.disk.clone();
        let log = JournalRecords::open(disk.clone(), &disk.written(), moment(), 0);
        // A reported outcome is known and unchanged.
        let ends: BTreeMap<TaskId, (State, String)> = log
            .ended(moment())
            .into_iter()
            .map(|(_, task)| (task.id, (task.state, task.text)))
            .collect();
        for (id, end) in &self.ended {
            assert_eq!(ends.get(id), Some(end), "{id} was told another end");
        }
        // A journaled outcome that was not reported is reported now.
        for (id, (state, text)) in &ends {
            if *state == State::Rejected {
                self.rejected.insert(*id, text.clone());
            } else {
                self.ended.insert(*id, (*state, text.clone()));
            }
        }
        let unended = log.unended();
        for id in self.asked.keys() {
            let told = self.ended.contains_key(id) || self.rejected.contains_key(id);
            if told || unended.iter().any(|(_, task)| task.id == *id) {
                continue;
            }
            assert!(
                !self.accepted.contains_key(id),
                "{id} was accepted and is forgotten"
            );
            // No client received its id, and it must never move.
            self.rejected.insert(*id, "forgotten".to_owned());
        }
        self.session = session(&disk);
        for (device, task) in unended {
            assert_eq!(device, "lab");
            // For its client it is accepted, however often that is said now.
            self.accepted.remove(&task.id);
            self.session.restore(self.now, task);
        }
        self.session.handle_connected(self.now);
        self.settle();
    }
}

#[test]
fn a_restarted_gateway_continues_the_devices_tasks() {
    let mut lab = Pair::new(1);
    let arm = lab.ask("arm", 1500);
    let belt = lab.ask("belt", 3000);
    lab.pass(Duration::from_millis(500));
    for _ in 0..3 {
        lab.restart(&mut Dice::new(1));
        lab.pass(Duration::from_millis(300));
    }
    lab.pass(Duration::from_secs(3));
    assert_eq!(ended(&lab, arm), (State::Completed, "at some place"));
    assert_eq!(ended(&lab, belt), (State::Completed, "at some place"));
    lab.check();
}

#[test]
fn a_journaled_but_unsent_start_never_runs() {
    let mut lab = Pair::new(1);
    lab.pass(Duration::from_millis(300));
    lab.down.cut(lab.now..lab.now + Duration::from_millis(100));
    let id = lab.ask("arm", 100);
    lab.pass(Duration::from_millis(50));
    lab.down.lose();
    lab.restart(&mut Dice::new(1));
    lab.pass(Duration::from_secs(2));
    let (state, text) = ended(&lab, id);
    assert_eq!(state, State::Failed);
    assert!(text.starts_with("never started: "), "{text}");
    lab.check();
}

#[test]
fn a_restarted_gateway_waits_for_a_silent_devices_timeout() {
    let mut lab = Pair::new(1);
    let arm = lab.ask("arm", 60_000);
    let belt = lab.ask("belt", 20_000);
    lab.pass(Duration::from_millis(500));
    let long = lab.now..lab.now + Duration::from_secs(10);
    lab.down.cut(long.clone());
    lab.up.cut(long);
    lab.restart(&mut Dice::new(1));
    lab.pass(Duration::from_millis(1900));
    assert!(lab.ended.is_empty());
    lab.pass(Duration::from_millis(200));
    assert_eq!(ended(&lab, arm), (State::Failed, "device is not answering"));
    lab.pass(Duration::from_secs(20));
    assert_eq!(ended(&lab, belt).0, State::Completed);
    lab.check();
}

#[test]
fn an_outcome_that_cannot_be_journaled_is_neither_reported_nor_acknowledged() {
    let mut lab = Pair::new(1);
    let id = lab.ask("arm", 400);
    lab.pass(Duration::from_millis(300));
    lab.disk.set_full(true);
    let refused = lab.ask("belt", 100);
    lab.pass(Duration::from_secs(3));
    assert!(lab.ended.is_empty());
    let why = "the journal on a simulated disk cannot be written: ";
    assert!(
        lab.rejected[&refused].starts_with(why),
        "{}",
        lab.rejected[&refused]
    );
    // The device still holds it: a gateway that is started now learns it.
    lab.restart(&mut Dice::new(1));
    lab.pass(Duration::from_secs(1));
    assert!(lab.ended.is_empty());
    lab.disk.set_full(false);
    lab.pass(Duration::from_millis(600));
    assert_eq!(ended(&lab, id), (State::Completed, "at some place"));
    lab.check();
}

#[test]
fn an_outcome_decided_by_the_gateway_is_journaled_before_it_is_reported() {
    let mut lab = Pair::new(1);
    let id = lab.ask("arm", 60_000);
    lab.pass(Duration::from_millis(300));
    lab.disk.set_full(true);
    lab.reset();
    lab.pass(Duration::from_secs(5));
    assert!(lab.ended.is_empty());
    lab.disk.set_full(false);
    lab.pass(Duration::from_millis(600));
    assert_eq!(ended(&lab, id), (State::Failed, "device was reset"));
    lab.check();
}

#[test]
fn a_task_that_never_started_is_not_confused_with_a_new_one() {
    for wait in (300..900).step_by(50) {
        let mut lab = Pair::new(1);
        lab.pass(Duration::from_millis(300));
        lab.down.cut(lab.now..lab.now + Duration::from_millis(100));
        let lost = lab.ask("arm", 100);
        lab.pass(Duration::from_millis(50));
        lab.down.lose();
        // Its end is kept back while the next task starts.
        lab.disk.set_full(true);
        lab.restart(&mut Dice::new(1));
        lab.pass(Duration::from_millis(wait));
        lab.disk.set_full(false);
        let next = lab.ask("arm", 10);
        lab.pass(Duration::from_secs(1));
        assert_eq!(ended(&lab, lost).0, State::Failed);
        assert_eq!(ended(&lab, next).0, State::Completed);
        lab.check();
    }
}

#[test]
fn a_start_lost_with_its_gateway_is_not_confused_with_another_task() {
    let mut lab = Pair::new(7);
    lab.pass(Duration::from_millis(300));
    // The Start is written down, and the gateway dies before the line takes it.
    let mine = lab.ask("belt", 700);
    lab.down.lose();
    assert_eq!(lab.world.borrow().begun.len(), 0);
    // Another gateway, with its own journal, takes over the device.
    let other = Disk::default();
    let disk = std::mem::replace(&mut lab.disk, other.clone());
    lab.session = session(&other);
    lab.session.handle_connected(lab.now);
    lab.settle();
    lab.pass(Duration::from_millis(1500));
    assert!(lab.session.is_up());
    let anothers = lab.ask("belt", 3000);
    lab.pass(Duration::from_millis(200));
    assert_eq!(lab.accepted.get(&anothers), Some(&1));
    // It dies too, and the first one comes back.
    lab.disk = disk.clone();
    let log = JournalRecords::open(disk.clone(), &disk.written(), moment(), 0);
    lab.session = session(&disk);
    for (_, task) in log.unended() {
        lab.session.restore(lab.now, task);
    }
    lab.session.handle_connected(lab.now);
    lab.settle();
    lab.pass(Duration::from_millis(6000));
    assert_eq!(lab.ended.get(&mine).map(|end| end.0), Some(State::Failed));
}

#[test]
fn a_reset_with_the_same_boot_id_is_no_rejection() {
    let mut lab = Pair::new(7);
    lab.pass(Duration::from_millis(300));
    let task = lab.ask("belt", 700);
    // It moves, and the answer is still on the line.
    while lab.world.borrow().begun.is_empty() {
        lab.now = lab.now + Duration::from_micros(50);
        lab.settle();
    }
    lab.up.lose();
    // The firmware's boot id is a constant.
    lab.boots -= 1;
    lab.reset();
    lab.pass(Duration::from_millis(6000));
    assert_eq!(lab.rejected.get(&task), None);
    assert_eq!(lab.ended.get(&task).map(|end| end.0), Some(State::Failed));
}

#[test]
fn a_device_with_an_out_of_range_link_timeout_is_rejected() {
    for (millis, taken) in [
        (0, false),
        (49, false),
        (50, true),
        (60_000, true),
        (60_001, false),
    ] {
        let mut lab = Pair::new(7);
        let mut identity = Identity::new("lab", "1", 1);
        identity.link_timeout = Duration::from_millis(millis);
        let motor = |place, loss| Motor {
            place,
            name: ["arm", "belt"][place],
            loss,
            world: Rc::clone(&lab.world),
            ends_at: Instant::ZERO,
            aborted: false,
        };
        let motors = [motor(0, Loss::Abort), motor(1, Loss::CarryOn)];
        lab.node = Node::new(identity, Acting::new(motors));
        lab.pass(Duration::from_millis(500));
        assert_eq!(lab.session.is_up(), taken, "{millis} ms");
    }
}
