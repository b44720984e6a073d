//! Firmware updates (`docs/link.md`, section 16).

use super::*;
use crate::update::{Firmware, Receiving, SelfTest, Updatable, UpdateError, Updater, Verification};
use ztl_core::link::update::{UpdateCommand, UpdateMessage};

/// A flash in memory. Its manifest is the version and the length of an image.
#[derive(Default)]
struct Memory {
    received: Grown<u8>,
    length: u32,
    /// How many calls the verification takes.
    verifies: u8,
    fails: Option<UpdateError>,
    confirm_fails: bool,
    on_trial: bool,
    restarts: u8,
}

impl Updater for &RefCell<Memory> {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: "desk",
            version: "1.0.0",
            confirmed: !self.borrow().on_trial,
            trial_ms: 60_000,
            self_test: Some(SelfTest {
                component: 0,
                goal: "50",
            }),
        }
    }

    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError> {
        let &[version, length] = manifest else {
            return Err(UpdateError::Manifest);
        };
        if version == 0 && !downgrade {
            return Err(UpdateError::Older);
        }
        let mut memory = self.borrow_mut();
        memory.length = length.into();
        Ok(Receiving {
            length: length.into(),
            offset: memory.received.len() as u32,
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        let mut memory = self.borrow_mut();
        assert_eq!(offset as usize, memory.received.len());
        assert!(memory.received.len() + bytes.len() <= memory.length as usize);
        memory.received.extend_from_slice(bytes);
        memory.fails.map_or(Ok(()), Err)
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        let mut memory = self.borrow_mut();
        assert_eq!(memory.received.len(), memory.length as usize);
        if let Some(left) = memory.verifies.checked_sub(1) {
            memory.verifies = left;
            return Ok(Verification::Continues);
        }
        memory.fails.map_or(Ok(Verification::Done), Err)
    }

    fn restart(&mut self) {
        self.borrow_mut().restarts += 1;
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        let mut memory = self.borrow_mut();
        if memory.confirm_fails {
            return Err(UpdateError::Storage);
        }
        memory.on_trial = false;
        Ok(())
    }
}

type Updated<'t> = Updatable<[Motor<'t>; 3], &'t RefCell<Memory>>;

fn updated<'t>(trace: &'t Trace, memory: &'t RefCell<Memory>) -> Updated<'t> {
    let slow = Motor {
        slow: 300,
        ..motor("h", Loss::Hold, trace)
    };
    let motors = [
        motor("a", Loss::Abort, trace),
        slow,
        motor("c", Loss::CarryOn, trace),
    ];
    Updatable::new(motors, memory)
}

fn with_updates(
    memory: Memory,
    play: impl FnOnce(&mut TestGateway<'_, Updated<'_>, 2>, &RefCell<Memory>, &Trace),
) {
    let (trace, memory) = (Trace::default(), RefCell::new(memory));
    let components = updated(&trace, &memory);
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    play(&mut gateway, &memory, &trace);
}

impl<C: Components, const TASKS: usize> TestGateway<'_, C, TASKS> {
    fn update(&mut self, seq: u8, command: UpdateCommand<'_>) -> Grown<String> {
        let command = UpdateMessage::Command(command);
        self.command(seq, Body::Update(command))
    }

    /// The phase that answers a command.
    #[track_caller]
    fn phase(&mut self, seq: u8, command: UpdateCommand<'_>) -> String {
        let heard = self.update(seq, command);
        let answer = heard.first().expect("an answer");
        let phase = answer.strip_prefix("Update(Phase(");
        let phase = phase.and_then(|phase| phase.strip_suffix("))"));
        phase.unwrap_or(answer).to_string()
    }
}

const fn begin(manifest: &[u8]) -> UpdateCommand<'_> {
    UpdateCommand::Begin {
        now: false,
        downgrade: false,
        manifest,
    }
}

const fn write(offset: u32, bytes: &[u8]) -> UpdateCommand<'_> {
    UpdateCommand::Write { offset, bytes }
}

const RECEIVING: &str = "Receiving { offset: ";

/// Begins when all components are safe.
fn begun(gateway: &mut TestGateway<'_, Updated<'_>, 2>, manifest: &[u8]) {
    assert_eq!(gateway.phase(1, begin(manifest)), "Stopping");
    gateway.pass(300);
    assert_eq!(gateway.phase(2, begin(manifest)), "Receiving { offset: 0 }");
}

#[test]
fn an_image_is_received_verified_and_run() {
    let memory = Memory {
        verifies: 2,
        ..Memory::default()
    };
    with_updates(memory, |gateway, memory, trace| {
        let firmware = gateway.update(1, UpdateCommand::Read);
        assert!(firmware[0].contains("version: \"1.0.0\", confirmed: true"));
        assert_eq!(gateway.phase(2, begin(&[1, 40])), "Stopping");
        assert_eq!(trace.borrow().as_slice(), ["a safe", "h safe", "c safe"]);
        assert_eq!(gateway.phase(3, begin(&[1, 40])), "Stopping");
        gateway.pass(300);
        assert_eq!(gateway.phase(4, begin(&[1, 40])), "Receiving { offset: 0 }");
        assert_eq!(
            gateway.phase(5, write(0, &[1; 32])),
            "Receiving { offset: 32 }"
        );
        // A repeated command, and an earlier piece in another session, change nothing.
        assert_eq!(
            gateway.phase(5, write(0, &[1; 32])),
            "Receiving { offset: 32 }"
        );
        gateway.hello(6, 1);
        assert_eq!(
            gateway.phase(1, write(0, &[9; 32])),
            "Receiving { offset: 32 }"
        );
        assert_eq!(
            gateway.phase(2, UpdateCommand::Finish),
            "Receiving { offset: 32 }"
        );
        assert_eq!(
            gateway.phase(3, write(32, &[2; 8])),
            "Receiving { offset: 40 }"
        );
        assert_eq!(
            memory.borrow().received,
            [[1; 32].as_slice(), &[2; 8]].concat()
        );
        assert_eq!(
            gateway.phase(4, UpdateCommand::Restart),
            "Receiving { offset: 40 }"
        );
        assert_eq!(gateway.phase(5, UpdateCommand::Finish), "Verifying");
        for _ in 0..2 {
            gateway.pass(0);
            assert_eq!(gateway.phase(6, UpdateCommand::Ask), "Verifying");
        }
        gateway.pass(0);
        assert_eq!(gateway.phase(7, UpdateCommand::Ask), "Ready");
        assert_eq!(gateway.phase(8, UpdateCommand::Restart), "Restarting");
        gateway.pass(99);
        assert_eq!(memory.borrow().restarts, 0, "the answer is being sent");
        gateway.pass(1);
        assert_eq!(memory.borrow().restarts, 1);
    });
}

#[test]
fn while_it_receives_pings_and_aborts_are_served_and_starts_are_refused() {
    with_updates(Memory::default(), |gateway, _, _| {
        gateway.start(1, 1, 2, "1000");
        let busy = gateway.update(2, begin(&[1, 40]));
        assert_eq!(
            busy[0],
            "2 Refused a task runs, and the update would end it"
        );
        let at_once = UpdateCommand::Begin {
            now: true,
            downgrade: false,
            manifest: &[1, 40],
        };
        assert_eq!(gateway.phase(3, at_once), "Stopping");
        assert!(
            gateway
                .pass(300)
                .contains(&"Ended 1 ABORTED a firmware update is in progress".to_string())
        );
        assert!(gateway.phase(4, at_once).starts_with(RECEIVING));
        assert_eq!(gateway.command(5, Body::Ping)[0], "5 Pong 1");
        assert_eq!(
            gateway.command(6, Body::Abort { task: LinkId(1) })[0],
            "6 Aborting 1"
        );
        assert_eq!(
            gateway.start(7, 2, 0, "5")[0],
            "7 Refused a firmware update is in progress"
        );
        assert_eq!(gateway.phase(8, UpdateCommand::Cancel), "Idle");
        assert_eq!(gateway.start(9, 2, 0, "5")[0], "9 Started 2");
    });
}

#[test]
fn pings_and_aborts_are_served_between_the_parts_of_a_verification_and_cancel_ends_it() {
    let memory = Memory {
        verifies: 200,
        ..Memory::default()
    };
    with_updates(memory, |gateway, memory, _| {
        begun(gateway, &[1, 32]);
        assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
        assert_eq!(gateway.phase(4, UpdateCommand::Finish), "Verifying");
        for part in 0..30 {
            let seq = 5 + 3 * part;
            gateway.pass(0);
            assert_eq!(memory.borrow().verifies, 199 - part);
            let pong = gateway.command(seq, Body::Ping);
            assert_eq!(pong[0], format!("{seq} Pong 0"));
            let aborting = gateway.command(seq + 1, Body::Abort { task: LinkId(1) });
            assert!(
                aborting[0].starts_with(&format!("{} ", seq + 1)),
                "{aborting:?}"
            );
            assert_eq!(gateway.phase(seq + 2, UpdateCommand::Ask), "Verifying");
        }
        assert_eq!(gateway.phase(95, UpdateCommand::Cancel), "Idle");
        let left = memory.borrow().verifies;
        gateway.pass(0);
        assert_eq!(memory.borrow().verifies, left);
        assert_eq!(gateway.start(96, 2, 0, "5")[0], "96 Started 2");
    });
}

#[test]
fn an_update_that_does_not_go_on_is_over_and_goes_on_where_it_ended() {
    with_updates(Memory::default(), |gateway, _, _| {
        begun(gateway, &[1, 64]);
        assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
        for seq in 4..14 {
            gateway.pass(499);
            gateway.command(seq, Body::Ping);
        }
        assert!(gateway.start(14, 1, 0, "5")[0].contains("update"));
        gateway.pass(10);
        assert_eq!(gateway.start(15, 1, 0, "5")[0], "15 Started 1");
        assert_eq!(gateway.phase(16, write(32, &[1; 32])), "Idle");
        gateway.pass(10);
        assert_eq!(gateway.phase(17, begin(&[1, 64])), "Stopping");
        gateway.pass(300);
        assert_eq!(
            gateway.phase(18, begin(&[1, 64])),
            "Receiving { offset: 32 }"
        );
    });
}

#[test]
fn what_does_not_fit_is_refused() {
    with_updates(Memory::default(), |gateway, memory, _| {
        begun(gateway, &[1, 40]);
        let misplaced = "Refused the piece does not fit the image";
        for (seq, bytes) in [(3, &[0; 8][..]), (4, &[0; 64]), (5, &[0; 33])] {
            assert_eq!(
                gateway.update(seq, write(0, bytes))[0],
                format!("{seq} {misplaced}")
            );
        }
        assert!(memory.borrow().received.is_empty());
        assert_eq!(gateway.phase(6, begin(&[1])), "Failed(Manifest)");
        assert_eq!(gateway.phase(7, begin(&[0, 40])), "Stopping");
        gateway.pass(300);
        assert_eq!(gateway.phase(8, begin(&[0, 40])), "Failed(Older)");
        assert_eq!(gateway.start(9, 1, 0, "5")[0], "9 Started 1");
    });
}

#[test]
fn a_flash_or_a_signature_that_fails_ends_the_update() {
    for fails in [UpdateError::Storage, UpdateError::Signature] {
        with_updates(Memory::default(), |gateway, memory, _| {
            begun(gateway, &[1, 40]);
            assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
            let last = if fails == UpdateError::Storage {
                memory.borrow_mut().fails = Some(fails);
                assert_eq!(gateway.phase(4, write(32, &[1; 8])), "Failed(Storage)");
                5
            } else {
                assert!(gateway.phase(4, write(32, &[1; 8])).starts_with(RECEIVING));
                memory.borrow_mut().fails = Some(fails);
                assert_eq!(gateway.phase(5, UpdateCommand::Finish), "Verifying");
                gateway.pass(0);
                assert_eq!(gateway.phase(6, UpdateCommand::Ask), "Failed(Signature)");
                7
            };
            assert_eq!(
                gateway.phase(last, UpdateCommand::Restart),
                format!("Failed({fails:?})")
            );
        });
    }
}

#[test]
fn firmware_on_trial_restarts_unless_it_is_confirmed() {
    let on_trial = || Memory {
        on_trial: true,
        ..Memory::default()
    };
    with_updates(on_trial(), |gateway, memory, trace| {
        gateway.pass(0);
        assert_eq!(gateway.phase(1, begin(&[1, 40])), "Failed(OnTrial)");
        assert_eq!(gateway.phase(2, UpdateCommand::Confirm), "Failed(OnTrial)");
        assert!(!memory.borrow().on_trial);
        gateway.pass(60_000);
        assert_eq!(memory.borrow().restarts, 0);
        assert!(trace.borrow().iter().all(|line| line != "c safe"));
    });
    with_updates(on_trial(), |gateway, memory, trace| {
        gateway.pass(0);
        gateway.pass(59_999);
        assert_eq!(gateway.start(1, 1, 2, "5000")[0], "1 Started 1");
        gateway.pass(1);
        assert_eq!(trace.borrow().last().unwrap(), "c safe");
        assert_eq!(memory.borrow().restarts, 0, "a component moves");
        assert!(gateway.start(2, 2, 2, "5000")[0].contains("Refused"));
        gateway.pass(300);
        assert_eq!(memory.borrow().restarts, 1);
    });
    with_updates(on_trial(), |gateway, memory, _| {
        gateway.pass(0);
        assert_eq!(gateway.phase(1, UpdateCommand::Restart), "Restarting");
        gateway.pass(300);
        assert_eq!(memory.borrow().restarts, 1);
    });
}

#[test]
fn commands_do_not_put_a_restart_off() {
    let memory = Memory {
        on_trial: true,
        ..Memory::default()
    };
    let (trace, memory) = (Trace::default(), RefCell::new(memory));
    let mut components = updated(&trace, &memory);
    // Longer than the node waits.
    components.components[1].slow = 600_000;
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.pass(0);
    assert_eq!(gateway.phase(1, UpdateCommand::Restart), "Restarting");
    let others = [
        UpdateCommand::Ask,
        UpdateCommand::Confirm,
        UpdateCommand::Cancel,
        UpdateCommand::Restart,
        begin(&[1, 40]),
    ];
    for (seq, command) in (2..).zip(others.into_iter().cycle().take(10)) {
        gateway.pass(490);
        assert_eq!(gateway.phase(seq, command), "Restarting");
    }
    assert_eq!(memory.borrow().restarts, 0, "a component moves");
    assert!(memory.borrow().on_trial);
    gateway.pass(200);
    assert!(memory.borrow().restarts > 0);
}

#[test]
fn commands_do_not_drop_a_verification() {
    let memory = Memory {
        verifies: 20,
        ..Memory::default()
    };
    with_updates(memory, |gateway, memory, _| {
        begun(gateway, &[1, 32]);
        assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
        assert_eq!(gateway.phase(4, UpdateCommand::Finish), "Verifying");
        memory.borrow_mut().confirm_fails = true;
        let others = [
            UpdateCommand::Ask,
            UpdateCommand::Confirm,
            UpdateCommand::Finish,
            UpdateCommand::Restart,
            write(0, &[1; 32]),
        ];
        for (seq, command) in (5..).zip(others) {
            gateway.pass(0);
            assert_eq!(gateway.phase(seq, command), "Verifying");
        }
        for _ in 0..20 {
            gateway.pass(0);
        }
        assert_eq!(gateway.phase(10, UpdateCommand::Ask), "Ready");
        assert_eq!(memory.borrow().restarts, 0);
    });
}

#[test]
fn an_answer_after_a_long_time_does_not_drop_a_verification() {
    let memory = Memory {
        verifies: 200,
        ..Memory::default()
    };
    with_updates(memory, |gateway, _, _| {
        begun(gateway, &[1, 32]);
        assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
        assert_eq!(gateway.phase(4, UpdateCommand::Finish), "Verifying");
        for _ in 0..60 {
            gateway.pass(100);
        }
        // Its answer waits when the node's turn comes.
        gateway.write(key(5), 5, Body::Ping);
        assert_eq!(gateway.pass(0), ["5 Pong 0"]);
        assert_eq!(gateway.phase(6, UpdateCommand::Ask), "Verifying");
    });
}

#[test]
fn a_task_ends_for_the_reason_that_stopped_it() {
    with_updates(Memory::default(), |gateway, _, _| {
        gateway.start(1, 9, 1, "50000");
        let at_once = UpdateCommand::Begin {
            now: true,
            downgrade: false,
            manifest: &[1, 32],
        };
        assert_eq!(gateway.phase(2, at_once), "Stopping");
        assert_eq!(gateway.phase(3, UpdateCommand::Cancel), "Idle");
        let ended = gateway.pass(310).join(", ");
        let why = "Ended 9 ABORTED a firmware update is in progress";
        assert!(ended.contains(why), "{ended}");
    });
}

#[test]
fn another_image_is_not_written_behind_a_part_of_the_first() {
    with_updates(Memory::default(), |gateway, _, _| {
        begun(gateway, &[1, 64]);
        assert!(gateway.phase(3, write(0, &[1; 32])).starts_with(RECEIVING));
        gateway.pass(1000);
        gateway.hello(6, 1);
        // The link was lost, so a component is on its way to its safe state again.
        assert_eq!(gateway.phase(1, begin(&[1])), "Stopping");
        gateway.pass(300);
        assert_eq!(gateway.phase(2, begin(&[1])), "Failed(Manifest)");
    });
}

#[test]
fn an_older_gateway_notices_nothing_of_updates() {
    let (trace, memory) = (Trace::default(), RefCell::default());
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), updated(&trace, &memory));
    let heard = play_older_gateway(gateway(&mut node));
    let components = updated(&trace, &memory).components;
    let mut plain = TestNode::<2>::new(Identity::new("desk", "1", 77), components);
    assert_eq!(heard, play_older_gateway(gateway(&mut plain)));
}

#[test]
fn updates_are_announced_beside_the_parameters() {
    with_updates(Memory::default(), |gateway, _, _| {
        let said = gateway.command(1, Body::Describe { index: 3 });
        let announced = Body::Description {
            index: 3,
            component: 255,
            bytes: &[0, 1],
        };
        assert_eq!(said[0], format!("{announced:?}"));
        assert!(gateway.command(2, Body::Describe { index: 4 })[0].contains("Refused"));
    });
}

#[test]
fn a_node_without_updates_drops_the_commands() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        assert!(gateway.update(1, UpdateCommand::Read).is_empty());
        assert!(gateway.update(1, begin(&[1, 40])).is_empty());
        assert_eq!(gateway.command(1, Body::Ping)[0], "1 Pong 0");
    });
}
