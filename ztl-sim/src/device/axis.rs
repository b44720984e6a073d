//! A motor that moves at constant speed.

use ztl_mcu::describe::{ComponentDescription, GoalRule};
use ztl_mcu::link::Offer;
use ztl_mcu::parameters::{Declaration, Text, Tunable, Value};
use ztl_mcu::{Component, Instant, Refused, Report, Run, description, parameters};

/// The properties of an axis.
#[derive(Debug)]
pub(super) struct AxisKind {
    name: &'static str,
    range: (f32, f32),
    unit: &'static str,
    /// Units per second.
    speed: f32,
    words: &'static str,
    /// Named positions.
    positions: &'static [(&'static str, f32)],
    /// The error message for any other goal.
    takes: &'static str,
    /// What it says of itself.
    pub(super) description: &'static str,
}

pub(super) const FINGER: AxisKind = AxisKind {
    name: "finger",
    range: (0.0, 100.0),
    unit: "percent",
    speed: 50.0,
    words: "",
    positions: &[],
    takes: "finger takes 0 to 100 percent",
    description: description!(ComponentDescription {
        about: Some("opens the finger"),
        result: Some("its opening in percent"),
        ..ComponentDescription::new(GoalRule::NUMBER)
    }),
};

pub(super) const PAN: AxisKind = AxisKind {
    name: "pan",
    range: (-90.0, 90.0),
    unit: "degrees",
    speed: 90.0,
    words: "left straight right",
    positions: &[("left", 90.0), ("straight", 0.0), ("right", -90.0)],
    takes: "pan takes -90 to 90 degrees, or left, straight, right",
    // No rule covers both numbers and words.
    description: description!(ComponentDescription {
        about: Some("turns the head"),
        examples: &["left", "straight", "right", "45"],
        result: Some("its angle in degrees"),
        ..ComponentDescription::new(GoalRule::Any)
    }),
};

parameters! {
    /// What people can set.
    #[derive(Debug)]
    pub(super) struct Settings {
        speed: f32 = Parameter::<f32>::new(1.0).range(0.1, 4.0).about("times its usual speed");
        label: Text<16> = Parameter::<Text<16>>::new("").about("what people call it");
    }
}

/// The motor and its movement.
#[derive(Debug)]
pub(super) struct Axis {
    kind: &'static AxisKind,
    settings: Settings,
    /// Where and when the movement began.
    from: (f32, Instant),
    target: f32,
    stopped: bool,
}

impl Axis {
    pub(super) fn new(kind: &'static AxisKind) -> Self {
        Self {
            kind,
            settings: Settings::default(),
            from: (0.0, Instant::ZERO),
            target: 0.0,
            stopped: false,
        }
    }

    fn position(&self, now: Instant) -> f32 {
        let (start, at) = self.from;
        let way = self.kind.speed * self.settings.speed * now.since(at).as_secs_f32();
        if self.target >= start {
            (start + way).min(self.target)
        } else {
            (start - way).max(self.target)
        }
    }

    fn move_to(&mut self, now: Instant, target: f32) {
        self.from = (self.position(now), now);
        self.target = target;
    }

    fn target_of(&self, goal: &str) -> Option<f32> {
        let word = self.kind.positions.iter().find(|(word, _)| *word == goal);
        word.map(|(_, place)| *place)
            .or_else(|| goal.trim().parse().ok())
            .filter(|target| (self.kind.range.0..=self.kind.range.1).contains(target))
    }

    fn stop(&mut self, now: Instant) {
        self.move_to(now, self.position(now));
        self.stopped = true;
    }
}

impl Tunable for Axis {
    const PARAMETERS: &'static [Declaration] = Settings::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.settings.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.settings.set(index, value);
    }
}

impl Component for Axis {
    fn offer(&self) -> Offer<'_> {
        let (least, most) = self.kind.range;
        Offer::new(self.kind.name)
            .with_range(least, most, self.kind.unit)
            .with_words(self.kind.words)
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.target_of(goal).map(drop).ok_or_else(|| {
            why.text(self.kind.takes);
            Refused
        })
    }

    fn start(&mut self, now: Instant, goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        let target = self.target_of(goal).ok_or(Refused)?;
        self.stopped = false;
        self.move_to(now, target);
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        let position = self.position(now);
        report.number(position, 1);
        if self.stopped {
            Run::Aborted
        } else if position == self.target {
            Run::Completed
        } else {
            Run::Running
        }
    }

    fn abort(&mut self, now: Instant) {
        self.stop(now);
    }

    fn make_safe(&mut self, now: Instant) {
        self.stop(now);
    }
}
