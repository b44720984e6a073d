//! Parameters: read, set and saved by a gateway (`docs/link.md`, section 13).

use super::*;
use crate::parameters;
use crate::parameters::{Declaration, SaveError, Storage, Text, Tunable, Tuned, Value};
use core::cell::Cell;
use std::collections::BTreeMap;
use ztl_core::link::parameter::{ParameterCommand, ParameterMessage};

parameters! {
    #[derive(Debug, Clone, PartialEq)]
    struct Calibration {
        speed: f32 = Parameter::<f32>::new(50.0).range(1.0, 100.0).unit("percent/s").about("how fast");
        reversed: bool = Parameter::<bool>::new(false);
    }
}

parameters! {
    struct Own {
        label: Text<8> = Parameter::<Text<8>>::new("desk");
    }
}

/// A motor with parameters.
struct Tuner<'t>(Motor<'t>, Calibration);

impl Component for Tuner<'_> {
    fn offer(&self) -> Offer<'_> {
        self.0.offer()
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.check(goal, why)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.0.start(now, goal, why)
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        self.0.poll(now, report)
    }

    fn abort(&mut self, now: Instant) {
        self.0.abort(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.0.make_safe(now);
    }
}

impl Tunable for Tuner<'_> {
    const PARAMETERS: &'static [Declaration] = Calibration::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.1.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.0.trace.borrow_mut().push(format!("set {value:?}"));
        self.1.set(index, value);
    }
}

/// Keeps values as a flash does, and fails when it is told to.
#[derive(Default)]
struct Kept {
    values: RefCell<BTreeMap<u64, Grown<u8>>>,
    fails: Cell<bool>,
}

impl Storage for &Kept {
    fn read(&mut self, key: u64, buffer: &mut [u8]) -> Result<Option<usize>, SaveError> {
        let values = self.values.borrow();
        let Some(value) = values.get(&key) else {
            return Ok(None);
        };
        buffer[..value.len()].copy_from_slice(value);
        Ok(Some(value.len()))
    }

    fn write(&mut self, key: u64, bytes: &[u8]) -> Result<(), SaveError> {
        if self.fails.get() {
            return Err(SaveError::Failed);
        }
        self.values.borrow_mut().insert(key, bytes.to_vec());
        Ok(())
    }
}

type Pair<'t> = (Tuner<'t>, Tuner<'t>);

fn pair(trace: &Trace) -> Pair<'_> {
    let tuner = |name, loss| Tuner(motor(name, loss, trace), Calibration::default());
    (tuner("a", Loss::Abort), tuner("c", Loss::CarryOn))
}

fn tuned<'k, 't>(trace: &'t Trace, kept: &'k Kept) -> Tuned<Pair<'t>, Own, &'k Kept, 5> {
    Tuned::new(pair(trace))
        .with_firmware(Own::default())
        .load(kept)
}

fn node<C: Components>(components: C) -> Node<'static, C, 2, 128> {
    Node::new(Identity::new("desk", "1", 77), components)
}

fn read(index: u8) -> Body<'static> {
    let command = ParameterCommand::Read { index };
    Body::Parameter(ParameterMessage::Command(command))
}

fn set(index: u8, value: Value<'_>) -> Body<'_> {
    let command = ParameterCommand::Set { index, value };
    Body::Parameter(ParameterMessage::Command(command))
}

const SAVE: Body<'static> = Body::Parameter(ParameterMessage::Command(ParameterCommand::Save));

impl<C: Components> TestGateway<'_, C, 2> {
    /// What an answer says of a parameter: component, name, value, and what a restart makes of it.
    fn ask(&mut self, seq: u8, body: Body<'_>) -> String {
        let heard = self.command(seq, body);
        let [answer] = &heard[..] else {
            panic!("{heard:?}")
        };
        let part = |from: &str, to: &str| {
            let rest = answer.split_once(from).map_or("", |(_, rest)| rest);
            rest.split_once(to).map_or("", |(part, _)| part).to_string()
        };
        match answer.strip_prefix("Parameter(Is(") {
            Some(_) => format!(
                "{} {} {} {}",
                part("component: ", ","),
                part("name: \"", "\""),
                part(", value: ", " }"),
                part("kept: ", ",")
            ),
            None => answer.clone(),
        }
    }
}

#[test]
fn the_gateway_learns_of_parameters_after_the_descriptions() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    let announced = Body::Description {
        index: 2,
        component: 255,
        bytes: &[5],
    };
    let heard = gateway.command(1, Body::Describe { index: 2 });
    assert_said(heard, &[&format!("{announced:?}")]);
    let heard = gateway.command(2, Body::Describe { index: 3 });
    assert_said(heard, &["2 Refused no such component"]);
}

#[test]
fn parameters_are_read_set_and_saved() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut first = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut first);
    gateway.hello(5, 1);
    for (seq, told) in (1..).zip([
        "0 speed F32(50.0) Saved",
        "0 reversed Bool(false) Saved",
        "1 speed F32(50.0) Saved",
        "1 reversed Bool(false) Saved",
        "255 label Text(\"desk\") Saved",
        "6 Refused no such parameter",
    ]) {
        assert_eq!(gateway.ask(seq, read(seq - 1)), told);
    }
    let fast = set(2, Value::F32(80.5));
    assert_eq!(gateway.ask(7, fast), "1 speed F32(80.5) Changed");
    let label = set(4, Value::Text("Grüße"));
    assert_eq!(gateway.ask(8, label), "255 label Text(\"Grüße\") Changed");
    assert_eq!(gateway.ask(9, SAVE), "Parameter(Saved)");
    assert_eq!(gateway.ask(10, read(2)), "1 speed F32(80.5) Saved");
    assert_eq!(kept.values.borrow().len(), 2, "only what differs");
    // After a restart.
    let mut second = node(tuned(&trace, &kept));
    let mut gateway = super::gateway(&mut second);
    gateway.hello(6, 1);
    assert_eq!(gateway.ask(1, read(0)), "0 speed F32(50.0) Saved");
    assert_eq!(gateway.ask(2, read(2)), "1 speed F32(80.5) Saved");
    assert_eq!(gateway.ask(3, read(4)), "255 label Text(\"Grüße\") Saved");
    // A default that replaces a saved value is saved, too.
    gateway.ask(4, set(2, Value::F32(50.0)));
    assert_eq!(gateway.ask(5, SAVE), "Parameter(Saved)");
    let mut third = node(tuned(&trace, &kept));
    let mut gateway = super::gateway(&mut third);
    gateway.hello(7, 1);
    assert_eq!(gateway.ask(1, read(2)), "1 speed F32(50.0) Saved");
}

#[test]
fn a_value_of_another_kind_or_range_changes_nothing() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    for (seq, index, value, why) in [
        (1, 0, Value::F32(100.5), "the value is out of its range"),
        (2, 0, Value::F32(f32::NAN), "the value is out of its range"),
        (3, 0, Value::U32(7), "the value is of another kind"),
        (
            4,
            4,
            Value::Text("too long!"),
            "the value is out of its range",
        ),
        (5, 5, Value::Bool(true), "no such parameter"),
    ] {
        assert_eq!(
            gateway.ask(seq, set(index, value)),
            format!("{seq} Refused {why}")
        );
    }
    assert_eq!(gateway.ask(6, read(0)), "0 speed F32(50.0) Saved");
    assert_eq!(*trace.borrow(), [""; 0]);
}

#[test]
fn a_repeated_set_is_answered_but_not_executed_again() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    let fast = || set(0, Value::F32(80.0));
    for _ in 0..3 {
        assert_eq!(gateway.ask(1, fast()), "0 speed F32(80.0) Changed");
    }
    assert_eq!(*trace.borrow(), ["set F32(80.0)"]);
    // Neither in another session nor out of sequence, nor without a session.
    assert_said(gateway.send(key(4), 2, fast()), &[]);
    assert_said(gateway.send(NO_SESSION, 2, fast()), &[]);
    assert_said(gateway.command(3, fast()), &[]);
    assert_said(gateway.command(NO_SEQ, fast()), &[]);
    assert_eq!(trace.borrow().len(), 1);
    // A refusal is repeated with its reason.
    for _ in 0..2 {
        let reply = gateway.ask(2, set(0, Value::F32(0.0)));
        assert_eq!(reply, "2 Refused the value is out of its range");
    }
}

#[test]
fn nothing_is_set_under_a_task_of_the_component_and_nothing_saved_under_any() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.start(1, 1, 1, "1000");
    let busy = "Refused a task runs that it would change";
    let fast = || set(2, Value::F32(80.0));
    assert_eq!(gateway.ask(2, fast()), format!("2 {busy}"));
    // The firmware's own parameters may concern every task.
    let label = set(4, Value::Text("x"));
    assert_eq!(gateway.ask(3, label), format!("3 {busy}"));
    // The other component has no task, and reading is always possible.
    let other = set(0, Value::F32(80.0));
    assert_eq!(gateway.ask(4, other), "0 speed F32(80.0) Changed");
    assert_eq!(gateway.ask(5, read(2)), "1 speed F32(50.0) Saved");
    let saving = "Refused not while a component moves or is not safe";
    assert_eq!(gateway.ask(6, SAVE), format!("6 {saving}"));
    gateway.command(7, Body::Abort { task: LinkId(1) });
    gateway.pass(1);
    assert_eq!(gateway.ask(8, fast()), "1 speed F32(80.0) Changed");
    assert_eq!(gateway.ask(9, SAVE), "Parameter(Saved)");
}

#[test]
fn nothing_is_set_on_the_way_to_the_safe_state() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut components = tuned(&trace, &kept);
    components.components.0.0.slow = 500;
    let mut node = node(components);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.command(1, Body::Ping);
    gateway.pass(1000);
    let fast = |index| set(index, Value::F32(80.0));
    let busy = "Refused a task runs that it would change";
    assert_eq!(gateway.ask(2, fast(0)), format!("2 {busy}"));
    // The other one carries on.
    assert_eq!(gateway.ask(3, fast(2)), "1 speed F32(80.0) Changed");
    gateway.pass(500);
    assert_eq!(gateway.ask(4, fast(0)), "0 speed F32(80.0) Changed");
}

#[test]
fn a_saved_value_that_does_not_fit_any_more_is_replaced_by_the_default_and_told() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut first = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut first);
    gateway.hello(5, 1);
    gateway.ask(1, set(0, Value::F32(80.0)));
    gateway.ask(2, set(1, Value::Bool(true)));
    gateway.ask(3, SAVE);
    // The next firmware takes less, and has another order.
    for saved in kept.values.borrow_mut().values_mut() {
        if saved[0] == 3 {
            saved[1..].copy_from_slice(&100.5f32.to_le_bytes());
        }
    }
    let mut second = node(tuned(&trace, &kept));
    let mut gateway = super::gateway(&mut second);
    gateway.hello(6, 1);
    assert_eq!(gateway.ask(1, read(0)), "0 speed F32(50.0) Replaced");
    assert_eq!(gateway.ask(2, read(1)), "0 reversed Bool(true) Saved");
    assert_eq!(
        gateway.ask(3, set(0, Value::F32(60.0))),
        "0 speed F32(60.0) Changed"
    );
    gateway.ask(4, SAVE);
    assert_eq!(gateway.ask(5, read(0)), "0 speed F32(60.0) Saved");
}

#[test]
fn a_storage_that_fails_is_told_and_the_values_stay() {
    let (trace, kept) = (Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    gateway.ask(1, set(0, Value::F32(80.0)));
    kept.fails.set(true);
    assert_eq!(
        gateway.ask(2, SAVE),
        "2 Refused the storage is full or broken"
    );
    assert_eq!(gateway.ask(3, read(0)), "0 speed F32(80.0) Changed");
    kept.fails.set(false);
    assert_eq!(gateway.ask(4, SAVE), "Parameter(Saved)");
}

#[test]
fn without_a_storage_values_last_until_the_next_restart() {
    let trace = Trace::default();
    let mut node = node(Tuned::new(pair(&trace)));
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    assert_eq!(
        gateway.ask(1, set(0, Value::F32(80.0))),
        "0 speed F32(80.0) Never"
    );
    let reply = gateway.ask(2, SAVE);
    assert_eq!(reply, "2 Refused this firmware saves no parameters");
}

#[test]
fn a_node_without_parameters_ignores_what_is_said_of_them() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        assert_said(gateway.command(1, read(0)), &[]);
        assert_said(gateway.command(1, Body::Ping), &["1 Pong 0"]);
        let counters = gateway.node.counters();
        assert_eq!((counters.errors, counters.out_of_sequence), (1, 0));
    });
}

#[test]
fn an_older_gateway_notices_nothing_of_parameters() {
    let (trace, other, kept) = (Trace::default(), Trace::default(), Kept::default());
    let mut node = node(tuned(&trace, &kept));
    let mut plain = super::parameters::node(pair(&other));
    let heard = play_older_gateway(gateway(&mut node));
    assert!(heard.len() > 10, "{heard:?}");
    assert_eq!(heard, play_older_gateway(gateway(&mut plain)));
}
