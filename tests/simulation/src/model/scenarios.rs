//! The scenarios.

use ztl_core::link::{Busy, Loss};

use super::Fault::{Copy, Cut, Drop, Hold, Kill, KillWriting, Reset, Stall, Tape, Unplug};
use super::motor::ENDLESS;
use super::{Act, Kind, Scenario, Way};

const ABORT: Kind = Kind {
    loss: Loss::Abort,
    busy: Busy::Refuse,
    fails: false,
};
const CARRY_ON: Kind = Kind {
    loss: Loss::CarryOn,
    busy: Busy::Refuse,
    fails: false,
};

const FAILS: Kind = Kind {
    fails: true,
    ..ABORT
};
const QUEUE: Kind = Kind {
    loss: Loss::Abort,
    busy: Busy::Queue(1),
    fails: false,
};
const REPLACE: Kind = Kind {
    loss: Loss::Hold,
    busy: Busy::Replace,
    fails: false,
};

pub(super) const fn ask(gateway: usize, motor: usize, millis: u16) -> Act {
    Act::Ask {
        gateway,
        motor,
        millis,
    }
}

pub(super) const fn abort(gateway: usize, task: usize) -> Act {
    Act::Abort { gateway, task }
}

const fn press(motor: usize, millis: u16) -> Act {
    Act::Press { motor, millis }
}

const fn set(gateway: usize, motor: usize) -> Act {
    Act::Set { gateway, motor }
}

const DOWN: Way = Way::Down;
const UP: Way = Way::Up;

/// One gateway without a journal, and one task that ends only when it is stopped.
pub(super) const PLAIN: Scenario = Scenario {
    name: "",
    about: "",
    motors: [ABORT, CARRY_ON],
    gateways: 1,
    late: false,
    journal: false,
    acts: &[ask(0, 0, ENDLESS)],
    faults: &[],
    times: 2,
};

/// All scenarios.
pub const SCENARIOS: &[Scenario] = &[
    Scenario {
        name: "frames",
        about: "a short task; frames are lost, delayed and repeated",
        acts: &[ask(0, 0, 40)],
        faults: &[
            Drop(DOWN),
            Drop(UP),
            Hold(DOWN),
            Hold(UP),
            Copy(DOWN),
            Copy(UP),
        ],
        ..PLAIN
    },
    Scenario {
        name: "cut",
        about: "an endless task; either direction is cut or stalled, a frame is delayed",
        faults: &[Cut(DOWN), Cut(UP), Stall(DOWN), Stall(UP), Hold(DOWN)],
        ..PLAIN
    },
    Scenario {
        name: "fails",
        about: "an endless task and a short one, of motors that fail to become safe at first; cuts, stalls, a frame is delayed",
        motors: [FAILS, FAILS],
        acts: &[ask(0, 0, ENDLESS), ask(0, 1, 40)],
        faults: &[Cut(DOWN), Cut(UP), Stall(DOWN), Stall(UP), Hold(DOWN)],
        ..PLAIN
    },
    Scenario {
        name: "late",
        about: "a Start that arrives just before its deadline, long after the last command",
        acts: &[ask(0, 1, 100), ask(0, 0, ENDLESS)],
        faults: &[Cut(DOWN), Hold(DOWN)],
        ..PLAIN
    },
    Scenario {
        name: "unplug",
        about: "an endless task; the line is closed, a direction is cut, frames are delayed",
        faults: &[Unplug, Cut(DOWN), Cut(UP), Hold(DOWN), Hold(UP)],
        ..PLAIN
    },
    Scenario {
        name: "carry-on",
        about: "a task that carries on without a link; cuts, stalls, resets",
        acts: &[ask(0, 1, ENDLESS)],
        faults: &[Cut(DOWN), Cut(UP), Stall(UP), Unplug, Reset],
        ..PLAIN
    },
    Scenario {
        name: "abort",
        about: "a task that is aborted; frames are lost and delayed, a direction is cut",
        acts: &[ask(0, 0, ENDLESS), abort(0, 0)],
        faults: &[Drop(DOWN), Drop(UP), Hold(DOWN), Cut(DOWN), Cut(UP)],
        ..PLAIN
    },
    Scenario {
        name: "reset",
        about: "a task; the device is reset, frames are lost, delayed and repeated",
        acts: &[ask(0, 0, 500)],
        faults: &[
            Reset,
            Drop(UP),
            Hold(DOWN),
            Hold(UP),
            Copy(DOWN),
            Stall(UP),
            Cut(UP),
        ],
        ..PLAIN
    },
    Scenario {
        name: "restart",
        about: "a task; the gateway is killed and restarted without a journal",
        acts: &[ask(0, 1, ENDLESS)],
        faults: &[Kill(0), Drop(UP), Hold(DOWN), Copy(DOWN), Cut(UP)],
        ..PLAIN
    },
    Scenario {
        name: "journal",
        about: "a task; the gateway is killed at any time and reads its journal",
        journal: true,
        acts: &[ask(0, 0, 500)],
        faults: &[
            Kill(0),
            KillWriting(0),
            Drop(UP),
            Hold(DOWN),
            Reset,
            Cut(UP),
            Cut(DOWN),
        ],
        ..PLAIN
    },
    Scenario {
        name: "queue",
        about: "a second task waits for the first, which may be aborted; the line is bad",
        motors: [QUEUE, CARRY_ON],
        acts: &[ask(0, 0, 300), ask(0, 0, 100), abort(0, 0)],
        faults: &[Drop(UP), Hold(DOWN), Cut(DOWN), Cut(UP), Reset],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "replace",
        about: "a second task replaces the first; the line is bad",
        motors: [REPLACE, CARRY_ON],
        acts: &[ask(0, 0, ENDLESS), ask(0, 0, 200)],
        faults: &[Drop(UP), Hold(DOWN), Cut(DOWN), Cut(UP), Reset],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "full",
        about: "more ended tasks than the device has room for, while it is not heard",
        acts: &[ask(0, 0, 40), ask(0, 1, 40), ask(0, 0, 40)],
        faults: &[Cut(UP), Drop(UP)],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "repeat",
        about: "a task; the line repeats all frames, in any session",
        acts: &[ask(0, 0, 40)],
        faults: &[Tape(DOWN), Tape(UP), Unplug, Cut(UP), Reset],
        ..PLAIN
    },
    Scenario {
        name: "renew",
        about: "a refused task, then more commands than fit a session, a task, an abort; frames are lost, delayed and repeated",
        acts: &[
            ask(0, 0, ENDLESS),
            ask(0, 0, 40),
            Act::Idle,
            ask(0, 1, 40),
            abort(0, 0),
        ],
        faults: &[
            Copy(UP),
            Hold(UP),
            Copy(DOWN),
            Hold(DOWN),
            Drop(UP),
            Drop(DOWN),
        ],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "two",
        about: "two gateways on one device, each with a task; one is killed, the line is bad",
        gateways: 2,
        acts: &[ask(0, 0, 500), ask(1, 0, 500)],
        faults: &[Kill(0), Cut(UP), Hold(DOWN), Drop(UP)],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "takeover",
        about: "a gateway's Start never arrives, another gateway takes over and is killed, the first comes back",
        gateways: 2,
        late: true,
        acts: &[ask(0, 1, ENDLESS), ask(1, 1, ENDLESS)],
        faults: &[Cut(DOWN), Kill(1)],
        ..PLAIN
    },
    Scenario {
        name: "own",
        about: "the device starts a task, its gateway starts another and aborts the first; the gateway is killed, the device reset, the line cut",
        journal: true,
        acts: &[press(1, ENDLESS), ask(0, 0, 40), abort(0, 0)],
        faults: &[Kill(0), KillWriting(0), Reset, Drop(UP), Cut(DOWN)],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "jog",
        about: "the device starts a short task, its gateway starts one of the same motor; frames are lost, delayed and repeated",
        journal: true,
        acts: &[press(0, 40), ask(0, 0, 40)],
        faults: &[
            Kill(0),
            KillWriting(0),
            Reset,
            Drop(UP),
            Drop(DOWN),
            Hold(UP),
            Copy(UP),
            Cut(UP),
            Cut(DOWN),
        ],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "own-restart",
        about: "the device starts a task; the gateway is killed and restarted without a journal",
        acts: &[press(1, ENDLESS), abort(0, 0)],
        faults: &[Kill(0), Drop(UP), Hold(DOWN), Copy(UP), Reset],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "set",
        about: "a client sets two values of a motor; frames are lost, delayed and repeated, the device is reset",
        acts: &[set(0, 0), set(0, 0)],
        faults: &[
            Drop(UP),
            Drop(DOWN),
            Hold(UP),
            Hold(DOWN),
            Copy(UP),
            Copy(DOWN),
            Cut(UP),
            Reset,
            Kill(0),
            Unplug,
        ],
        times: 1,
        ..PLAIN
    },
    // With further faults, a value is set again: clause 13.10.
    Scenario {
        name: "set-repeat",
        about: "a client sets two values of a motor; the line repeats all frames of a session",
        acts: &[set(0, 0), set(0, 0)],
        faults: &[Tape(DOWN), Tape(UP)],
        times: 1,
        ..PLAIN
    },
    Scenario {
        name: "set-task",
        about: "a client starts a task, another sets a value of its motor before, during and after it",
        acts: &[ask(0, 0, 40), set(0, 0), abort(0, 0)],
        faults: &[Drop(UP), Hold(DOWN), Copy(DOWN), Cut(DOWN), Reset],
        times: 1,
        ..PLAIN
    },
];
