//! An axis with a driver chip: counts steps, and asserts what a driver's data sheet demands.

use core::cell::RefCell;
use std::rc::Rc;
use std::string::String;
use std::vec::Vec;

use critical_section::Mutex;
use embedded_hal::digital::{ErrorType, InputPin, OutputPin};

use super::super::*;
use crate::components::testing::{self, Broken};

/// The axis as the world has it.
#[derive(Debug)]
pub(super) struct Axis {
    now: u64,
    config: StepperConfig,
    low: Option<i32>,
    high: Option<i32>,
    position: i32,
    step: bool,
    direction: Option<bool>,
    turns: usize,
    powered: Option<bool>,
    powered_at: u64,
    direction_at: u64,
    edge_at: Option<u64>,
    /// When steps were made.
    steps: Vec<u64>,
    failing: &'static str,
}

impl Axis {
    pub(super) fn free() -> Self {
        Self {
            now: 1000,
            config: StepperConfig::DEFAULT,
            low: None,
            high: None,
            position: 0,
            step: false,
            direction: None,
            turns: 0,
            powered: None,
            powered_at: 0,
            direction_at: 0,
            edge_at: None,
            steps: Vec::new(),
            failing: "none",
        }
    }

    /// With switches at these positions.
    pub(super) fn between(low: i32, high: i32) -> Self {
        Self {
            low: Some(low),
            high: Some(high),
            ..Self::free()
        }
    }

    fn set_step(&mut self, level: bool) {
        if self.step == level {
            return;
        }
        self.step = level;
        let now = self.now;
        let width = now - self.edge_at.replace(now).unwrap_or(0);
        let least = u64::from(self.config.pulse_us);
        assert!(width >= least, "an edge {width} µs after the last");
        if !level {
            return;
        }
        assert_eq!(self.powered, Some(true), "a step without power");
        let lead = now - self.powered_at;
        let least = u64::from(self.config.enable_us);
        assert!(lead >= least, "a step {lead} µs after power came on");
        let setup = now - self.direction_at;
        let least = u64::from(self.config.direction_us);
        assert!(setup >= least, "a step {setup} µs after the direction");
        if let Some(last) = self.steps.last() {
            let interval = now - last;
            let least = 1_000_000u64.div_ceil(self.config.speed.into());
            assert!(interval >= least, "a step {interval} µs after the last");
        }
        let forward = self.direction.expect("a direction before the first step");
        self.position += if forward { 1 } else { -1 };
        self.steps.push(now);
    }

    fn set_direction(&mut self, level: bool) {
        assert!(!self.step, "the direction changes within a pulse");
        self.direction = Some(level != self.config.reverse);
        self.direction_at = self.now;
        self.turns += 1;
    }

    fn set_enable(&mut self, level: bool) {
        let powered = Some(level == self.config.enable_high);
        if self.powered != powered {
            self.powered = powered;
            self.powered_at = self.now;
        }
    }

    fn switch(&self, name: &str) -> bool {
        match name {
            "low" => self.low.is_some_and(|low| self.position <= low),
            _ => self.high.is_some_and(|high| self.position >= high),
        }
    }
}

/// A pin of the axis.
#[derive(Debug, Clone)]
pub(super) struct Pin(&'static str, Rc<RefCell<Axis>>);

impl Pin {
    fn works(&self) -> Result<(), Broken> {
        if self.1.borrow().failing.contains(self.0) {
            Err(Broken)
        } else {
            Ok(())
        }
    }

    fn set(&self, level: bool) -> Result<(), Broken> {
        self.works()?;
        let mut axis = self.1.borrow_mut();
        match self.0 {
            "step" => axis.set_step(level),
            "direction" => axis.set_direction(level),
            _ => axis.set_enable(level),
        }
        Ok(())
    }
}

impl ErrorType for Pin {
    type Error = Broken;
}

impl OutputPin for Pin {
    fn set_low(&mut self) -> Result<(), Broken> {
        self.set(false)
    }

    fn set_high(&mut self) -> Result<(), Broken> {
        self.set(true)
    }
}

impl InputPin for Pin {
    fn is_high(&mut self) -> Result<bool, Broken> {
        self.works()?;
        Ok(self.1.borrow().switch(self.0))
    }

    fn is_low(&mut self) -> Result<bool, Broken> {
        self.is_high().map(|high| !high)
    }
}

type Ends<L> = StepMotor<Pin, Pin, Pin, L, L>;
type Shared = &'static Mutex<RefCell<Ends<NoLimit>>>;

/// A component with its axis.
pub(super) struct Bench {
    axis: Rc<RefCell<Axis>>,
    stepper: std::boxed::Box<dyn Component>,
    interrupt: Option<Shared>,
}

impl Bench {
    pub(super) fn new(config: StepperConfig, axis: Axis) -> Self {
        let ends = axis.low.is_some();
        let (axis, motor) = motor(config, axis);
        let pin = |name| Switch::active_high(Pin(name, Rc::clone(&axis)));
        let stepper: std::boxed::Box<dyn Component> = if ends {
            let motor = motor
                .with_low_limit(pin("low"))
                .with_high_limit(pin("high"));
            std::boxed::Box::new(Stepper::new("slide", motor, config))
        } else {
            std::boxed::Box::new(Stepper::new("slide", motor, config))
        };
        Self {
            axis,
            stepper,
            interrupt: None,
        }
    }

    pub(super) fn with_interrupt(config: StepperConfig) -> Self {
        let (axis, motor) = motor(config, Axis::free());
        let shared: Shared =
            std::boxed::Box::leak(std::boxed::Box::new(Mutex::new(RefCell::new(motor))));
        Self {
            axis,
            stepper: std::boxed::Box::new(Stepper::new("slide", shared, config)),
            interrupt: Some(shared),
        }
    }

    fn now(&self) -> Instant {
        Instant::from_micros(self.now_us())
    }

    pub(super) fn now_us(&self) -> u64 {
        self.axis.borrow().now
    }

    pub(super) fn pass(&mut self, micros: u64) {
        self.axis.borrow_mut().now += micros;
    }

    pub(super) fn until_wake(&self) -> u64 {
        let wake = self.stepper.poll_timeout(self.now()).as_micros();
        wake.saturating_sub(self.now_us())
    }

    pub(super) fn start(&mut self, goal: &str) -> Result<(), String> {
        let now = self.now();
        testing::start(&mut *self.stepper, now, goal)
    }

    pub(super) fn poll(&mut self) -> (Run, String) {
        let now = self.now();
        testing::poll(&mut *self.stepper, now)
    }

    pub(super) fn abort(&mut self) {
        let now = self.now();
        self.stepper.abort(now);
    }

    pub(super) fn make_safe(&mut self) {
        let now = self.now();
        self.stepper.make_safe(now);
    }

    /// Returns when to call it next.
    pub(super) fn interrupt(&mut self) -> u64 {
        let now = self.now();
        let motor = self.interrupt.expect("one behind a mutex");
        let wake = critical_section::with(|token| motor.borrow(token).borrow_mut().tick(now));
        wake.as_micros()
    }

    pub(super) fn fail(&mut self, pin: &'static str) {
        self.axis.borrow_mut().failing = pin;
    }

    pub(super) fn position(&self) -> i32 {
        self.axis.borrow().position
    }

    /// Whether a step's pulse is up.
    pub(super) fn is_pulsing(&self) -> bool {
        self.axis.borrow().step
    }

    pub(super) fn is_powered(&self) -> bool {
        self.axis.borrow().powered == Some(true)
    }

    pub(super) fn steps(&self) -> Vec<u64> {
        self.axis.borrow().steps.clone()
    }

    /// How often the direction was set.
    pub(super) fn turns(&self) -> usize {
        self.axis.borrow().turns
    }

    pub(super) fn shortest_interval(&self) -> u64 {
        let steps = self.steps();
        let intervals = steps.windows(2).map(|two| two[1] - two[0]);
        intervals.min().unwrap_or(u64::MAX)
    }
}

fn motor(config: StepperConfig, axis: Axis) -> (Rc<RefCell<Axis>>, Ends<NoLimit>) {
    let axis = Rc::new(RefCell::new(Axis { config, ..axis }));
    let pin = |name| Pin(name, Rc::clone(&axis));
    let motor = StepMotor::new(pin("step"), pin("direction"), &config).with_enable(pin("enable"));
    (axis, motor)
}
