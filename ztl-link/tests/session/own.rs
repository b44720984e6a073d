//! Tasks that the firmware starts itself, and its events.

use ztl_core::link::LinkId;

use super::*;

impl Pair {
    /// The firmware starts a task, as a jog button does. Returns its goal.
    fn press(&mut self, component: u8, millis: u64) -> String {
        self.pressed += 1;
        let goal = format!("{} {millis}", 1000 + self.pressed);
        self.note(format!("pressed for {goal}"));
        let started = self.node.start_here(self.now, component, &goal);
        started.expect("it starts");
        self.settle();
        goal
    }

    /// The ids under which clients know a task of the firmware.
    fn ids(&self, goal: &str) -> Vec<TaskId> {
        let its = self.asked.iter().filter(|(_, asked)| *asked == goal);
        its.map(|(id, _)| *id).collect()
    }

    #[track_caller]
    fn id(&self, goal: &str) -> TaskId {
        let ids = self.ids(goal);
        assert_eq!(ids.len(), 1, "{goal} has {ids:?}");
        ids[0]
    }

    /// Ready for tasks.
    fn up() -> Self {
        let mut lab = Self::new(1);
        lab.pass(Duration::from_millis(300));
        lab
    }
}

const SHORT: Duration = Duration::from_millis(150);

#[test]
fn a_task_of_the_firmware_gets_one_id_and_one_end_and_can_be_aborted() {
    let mut lab = Pair::up();
    let goal = lab.press(0, 60_000);
    lab.pass(SHORT);
    let id = lab.id(&goal);
    assert!(lab.session.is_own(id));
    assert_eq!(lab.session.policy(id), Some(Loss::Abort));
    let asked = lab.ask("arm", 10);
    lab.pass(SHORT);
    assert_eq!(lab.rejected[&asked], "busy with another task");
    lab.abort(id);
    lab.pass(SHORT);
    assert_eq!(ended(&lab, id), (State::Aborted, "at some place"));
    let short = lab.press(0, 0);
    lab.pass(SHORT);
    assert_eq!(ended(&lab, lab.id(&short)).0, State::Completed);
    lab.pass(Duration::from_secs(3));
    lab.check();
}

#[test]
fn lost_frames_delay_a_task_of_the_firmware_and_change_nothing() {
    for (down, up) in [(true, false), (false, true), (true, true)] {
        let mut lab = Pair::up();
        let cut = lab.now..lab.now + Duration::from_millis(250);
        if down {
            lab.down.cut(cut.clone());
        }
        if up {
            lab.up.cut(cut);
        }
        let first = lab.press(0, 50);
        let second = lab.press(1, 100);
        lab.pass(Duration::from_secs(1));
        for goal in [first, second] {
            assert_eq!(ended(&lab, lab.id(&goal)).0, State::Completed);
        }
        lab.check();
    }
}

#[test]
fn a_restarted_gateway_gives_no_second_id() {
    let mut lab = Pair::up();
    let running = lab.press(1, 2500);
    let short = lab.press(0, 100);
    lab.pass(SHORT);
    // The end arrives, and no Ack for it.
    lab.down.cut(lab.now..lab.now + Duration::from_millis(200));
    lab.pass(Duration::from_millis(100));
    assert_eq!(ended(&lab, lab.id(&short)).0, State::Completed);
    for _ in 0..3 {
        lab.restart(&mut Dice::new(1));
        lab.pass(Duration::from_millis(300));
    }
    let ids = [lab.id(&running), lab.id(&short)];
    lab.pass(Duration::from_secs(3));
    assert_eq!(ids, [lab.id(&running), lab.id(&short)]);
    assert_eq!(ended(&lab, ids[0]).0, State::Completed);
    lab.check();
}

#[test]
fn without_a_gateway_a_task_starts_and_is_taken_up_when_there_is_one() {
    let mut lab = Pair::new(1);
    lab.session.handle_disconnected();
    let goal = lab.press(1, 60_000);
    assert!(lab.node.start_here(lab.now, 0, "1 1").is_err(), "no link");
    lab.pass(Duration::from_secs(5));
    assert_eq!(lab.ids(&goal), []);
    lab.replug();
    lab.pass(Duration::from_millis(500));
    let id = lab.id(&goal);
    // The task carries on without a link, and its id for clients stays.
    lab.session.handle_disconnected();
    lab.pass(Duration::from_secs(5));
    assert!(!lab.ended.contains_key(&id));
    lab.replug();
    lab.pass(Duration::from_millis(500));
    lab.abort(id);
    lab.pass(SHORT);
    assert_eq!(ended(&lab, id).0, State::Aborted);
    lab.check();
}

#[test]
fn a_reset_and_a_lost_link_fail_a_task_of_the_firmware() {
    let mut lab = Pair::up();
    let goal = lab.press(1, 60_000);
    lab.pass(SHORT);
    lab.reset();
    lab.pass(Duration::from_secs(1));
    assert_eq!(
        ended(&lab, lab.id(&goal)),
        (State::Failed, "device was reset")
    );
    // Its numbers begin again.
    let goal = lab.press(0, 60_000);
    lab.pass(SHORT);
    let id = lab.id(&goal);
    lab.session.handle_disconnected();
    lab.pass(Duration::from_millis(2500));
    assert_eq!(ended(&lab, id), (State::Failed, "device is not answering"));
    lab.replug();
    lab.pass(Duration::from_secs(1));
    lab.check();
}

#[test]
fn a_firmware_with_a_constant_boot_id_is_taken_up_after_its_reset() {
    let mut lab = Pair::up();
    let first = lab.press(0, 10);
    lab.pass(SHORT);
    lab.boots -= 1;
    lab.reset();
    lab.pass(Duration::from_secs(3));
    let second = lab.press(0, 10);
    lab.pass(SHORT);
    assert_ne!(lab.id(&first), lab.id(&second));
    lab.check();
}

#[test]
fn a_task_that_another_gateway_has_ended_does_not_run_for_ever() {
    let mut lab = Pair::up();
    let goal = lab.press(1, 500);
    lab.pass(SHORT);
    let id = lab.id(&goal);
    // Its outcome is acknowledged by another gateway.
    lab.session.handle_disconnected();
    lab.pass(Duration::from_secs(3));
    let mut other = std::mem::replace(&mut lab.session, session(&Disk::default()));
    lab.session.handle_connected(lab.now);
    lab.foreign = true;
    lab.pass(Duration::from_secs(3));
    lab.session.handle_disconnected();
    lab.pass(Duration::from_secs(3));
    std::mem::swap(&mut lab.session, &mut other);
    lab.foreign = false;
    lab.session.handle_connected(lab.now);
    lab.pass(Duration::from_secs(2));
    assert_eq!(
        ended(&lab, id),
        (State::Failed, "the device no longer holds the task")
    );
}

#[test]
fn a_full_disk_delays_the_id() {
    let mut lab = Pair::up();
    lab.disk.set_full(true);
    let goal = lab.press(0, 100);
    lab.pass(Duration::from_millis(700));
    assert_eq!(lab.ids(&goal), []);
    lab.disk.set_full(false);
    lab.pass(Duration::from_millis(300));
    assert_eq!(ended(&lab, lab.id(&goal)).0, State::Completed);
    lab.check();
}

#[test]
fn each_event_is_reported_once() {
    let mut lab = Pair::up();
    lab.down.cut(lab.now..lab.now + Duration::from_millis(350));
    for number in 0..4 {
        assert!(lab.node.report_event(lab.now, &format!("event {number}")));
    }
    lab.pass(Duration::from_secs(1));
    assert_eq!(lab.reported, ["event 0", "event 1", "event 2", "event 3"]);
    lab.reset();
    lab.pass(Duration::from_secs(1));
    lab.node.report_event(lab.now, "after the reset");
    lab.pass(SHORT);
    assert_eq!(lab.reported.last().unwrap(), "after the reset");
    assert_eq!(lab.node.events_lost(), 0);
}

#[test]
fn tasks_of_a_line_with_faults_have_one_id_and_one_end() {
    for seed in 0..30 {
        let mut lab = Pair::new(seed);
        let mut dice = Dice::new(seed);
        lab.pass(Duration::from_millis(300));
        let faults = Faults {
            flip: 0.0005,
            drop: 0.002,
            double: 0.002,
            ..Faults::default()
        };
        lab.up.set_faults(faults);
        lab.down.set_faults(faults);
        let mut goals = Vec::new();
        for _ in 0..12 {
            let component = dice.below(2) as u8;
            let goal = format!("{} {}", 1000 + lab.pressed, dice.below(400));
            lab.pressed += 1;
            if lab.node.start_here(lab.now, component, &goal).is_ok() {
                goals.push(goal);
            }
            if dice.below(6) == 0 {
                lab.restart(&mut dice);
            }
            lab.pass(Duration::from_millis(dice.below(500)));
        }
        lab.up.set_faults(Faults::default());
        lab.down.set_faults(Faults::default());
        lab.pass(Duration::from_secs(5));
        for goal in goals {
            let id = lab.id(&goal);
            assert!(lab.ended.contains_key(&id), "{goal}: {:#?}", lab.trace);
        }
    }
}

#[test]
fn numbers_of_tasks_of_the_firmware_are_apart() {
    assert!(LinkId::local(1).is_local());
    assert!(!LinkId(0x7fff_ffff).is_local());
}
