//! The actuator of `docs/firmware-guide.md`, and what it does on the host. Each of the guide's Rust blocks stands here.

use core::convert::Infallible;
use core::future::Future;
use core::pin::pin;
use core::task::{Context, Waker};
use core::time::Duration;
use std::cell::Cell;
use std::rc::Rc;

use embedded_hal::pwm::SetDutyCycle;
use embedded_hal_async::delay::DelayNs;
use embedded_hal_async::i2c::{self, I2c};
use embedded_io::{Read, ReadReady, Write};
use ztl_mcu::describe::{ComponentDescription, Describe, Described, GoalType};
use ztl_mcu::driver::{Driver, Failed, Progress, Slot};
use ztl_mcu::link::Offer;
use ztl_mcu::parameters::{Declaration, Tunable, Tuned, Value};
use ztl_mcu::pump::Pump;
use ztl_mcu::{
    Acting, Component, Identity, Instant, Node, Reason, Refused, Report, Run, description,
    parameters, parse_goal,
};

const GUIDE: &str = include_str!("../../docs/firmware-guide.md");

/// The goal in percent, or why not.
fn opening(goal: &str, why: &mut Report<'_>) -> Result<f32, Refused> {
    let percent: f32 = parse_goal(goal, why)?;
    if !(0.0..=100.0).contains(&percent) {
        why.text("valve opens 0 to 100 %");
        return Err(Refused);
    }
    Ok(percent)
}

/// A valve on a PWM output. It opens by 50 % a second.
struct Valve<P> {
    pwm: P,
    at: f32,
    goal: f32,
    tick: Instant,
    calibration: Calibration,
}

parameters! {
    struct Calibration {
        speed: f32 = Parameter::<f32>::new(1.0).range(0.1, 5.0).unit("%/tick");
    }
}

impl<P> Tunable for Valve<P> {
    const PARAMETERS: &'static [Declaration] = Calibration::PARAMETERS;

    fn value(&self, index: usize) -> Option<Value<'_>> {
        self.calibration.value(index)
    }

    fn set(&mut self, index: usize, value: Value<'_>) {
        self.calibration.set(index, value);
    }
}

const STEP: Duration = Duration::from_millis(20);

impl<P: SetDutyCycle> Component for Valve<P> {
    fn offer(&self) -> Offer<'_> {
        Offer::new("valve").with_range(0.0, 100.0, "%")
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        opening(goal, why).map(drop)
    }

    fn start(&mut self, now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.goal = opening(goal, why)?;
        self.tick = now + STEP;
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        if now >= self.tick {
            self.tick = now + STEP;
            let speed = self.calibration.speed;
            self.at += (self.goal - self.at).clamp(-speed, speed);
        }
        report.number(self.at, 0);
        if self.pwm.set_duty_cycle_percent(self.at as u8).is_err() {
            report.text(" %, output failed");
            return Run::Failed;
        }
        match self.at == self.goal {
            true => Run::Completed,
            false => Run::Running,
        }
    }

    fn abort(&mut self, _: Instant) {
        self.goal = self.at;
    }

    fn make_safe(&mut self, _: Instant) {
        self.goal = 0.0;
    }

    fn poll_timeout(&self, _: Instant) -> Instant {
        self.tick
    }

    fn next_tick(&self) -> Instant {
        match self.at == self.goal {
            true => Instant::NEVER,
            false => self.tick,
        }
    }
}

impl<P> Describe for Valve<P> {
    const DESCRIPTION: &str = description!(ComponentDescription {
        about: Some("opens a valve; it closes when the link is lost"),
        examples: &["25"],
        ..ComponentDescription::new(f32::GOAL)
    });
}

fn closed_valve<P>(pwm: P) -> Valve<P> {
    Valve {
        pwm,
        at: 0.0,
        goal: 0.0,
        tick: Instant::ZERO,
        calibration: Calibration::default(),
    }
}

#[expect(dead_code, reason = "firmware")]
fn firmware(
    pwm: impl SetDutyCycle,
    mut uart: impl Read + ReadReady + Write,
    boot: u32,
    clock: fn() -> Instant,
    is_pressed: fn() -> bool,
) -> ! {
    let valve = closed_valve(pwm);
    let parts = Acting::new(Described(Tuned::new((valve,))));
    let mut node = Node::<_, 2, 128>::new(Identity::new("boiler", "1.0.0", boot), parts);
    loop {
        if is_pressed()
            && let Err(reason) = node.start_here(clock(), 0, "100")
        {
            node.report_event(clock(), &reason);
        }
        let _ = Pump::new().turn(&mut node, &mut uart, clock()); // a line error is expected; the node recovers
    }
}

/// The valve's successor on an I2C bus: writing register 0 sets the goal in percent, reading register 1 returns the opening in percent.
struct BusValve<I, D> {
    bus: I,
    delay: D,
}

const VALVE: u8 = 0x2A;

impl<I: I2c, D: DelayNs> BusValve<I, D> {
    async fn go(&mut self, percent: u8, progress: Progress<'_>) -> Result<(), I::Error> {
        self.bus.write(VALVE, &[0, percent]).await?;
        let mut at = [0];
        while at != [percent] {
            self.delay.delay_ms(20).await;
            self.bus.write_read(VALVE, &[1], &mut at).await?;
            progress.write(|report| report.number(at[0].into(), 0));
        }
        Ok(())
    }
}

impl<I: I2c, D: DelayNs> Driver for BusValve<I, D> {
    fn check(goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        opening(goal, why).map(drop)
    }

    async fn run(&mut self, goal: &str, progress: Progress<'_>) -> Result<(), Failed> {
        let percent = progress
            .write(|why| opening(goal, why))
            .map_err(|_| Failed)?;
        if self.go(percent as u8, progress).await.is_err() {
            progress.write(|report| report.text("valve does not answer"));
            return Err(Failed);
        }
        Ok(())
    }

    async fn make_safe(&mut self) {
        while self.bus.write(VALVE, &[0, 0]).await.is_err() {
            self.delay.delay_ms(20).await;
        }
    }
}

/// The duty of an output, in percent.
struct Pwm(Rc<Cell<u16>>);

impl embedded_hal::pwm::ErrorType for Pwm {
    type Error = Infallible;
}

impl SetDutyCycle for Pwm {
    fn max_duty_cycle(&self) -> u16 {
        100
    }

    fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
        self.0.set(duty);
        Ok(())
    }
}

/// When a task that starts at zero has opened the valve by half, and its result.
#[expect(clippy::unwrap_used, reason = "a helper of tests may panic")]
fn open_by_half(valve: &mut Valve<Pwm>) -> (Instant, Reason) {
    let (mut text, mut now) = (Reason::new(), Instant::ZERO);
    valve.start(now, "50", &mut Report::new(&mut text)).unwrap();
    while valve.poll(now, &mut Report::new(&mut text)) == Run::Running {
        now = valve.poll_timeout(now);
    }
    (now, text)
}

#[test]
fn the_valve_opens_by_half_in_a_second() {
    let duty = Rc::new(Cell::new(0));
    let mut valve = closed_valve(Pwm(duty.clone()));
    let (now, text) = open_by_half(&mut valve);
    assert_eq!(
        (now.as_millis(), duty.get(), text.as_str()),
        (1000, 50, "50")
    );
}

#[test]
fn the_valve_closes_without_a_task() {
    let duty = Rc::new(Cell::new(0));
    let mut valve = closed_valve(Pwm(duty.clone()));
    (valve.at, valve.goal) = (30.0, 30.0);
    let mut node = Node::<_, 2, 128>::new(Identity::new("boiler", "1.0.0", 7), (valve,));
    let mut now = Instant::ZERO;
    node.stop_everything(now);
    for _ in 0..100 {
        now = now + STEP;
        node.handle_timeout(now);
    }
    assert_eq!((node.components().0.at, duty.get()), (0.0, 0));
}

#[test]
fn a_button_opens_the_valve_only_with_a_gateway_and_at_its_own_speed() {
    let duty = Rc::new(Cell::new(0));
    let mut valve = closed_valve(Pwm(duty.clone()));
    Tunable::set(&mut valve, 0, Value::F32(5.0));
    let (now, _) = open_by_half(&mut valve);
    assert_eq!((now.as_millis(), duty.get()), (200, 50));
    let parts = Acting::new(Described(Tuned::new((valve,))));
    let mut node = Node::<_, 2, 128>::new(Identity::new("boiler", "1.0.0", 7), parts);
    let refused = node.start_here(now, 0, "100").unwrap_err();
    assert_eq!(refused.as_str(), "no link");
    assert!(node.report_event(now, &refused));
}

#[test]
fn a_wrong_goal_is_refused_with_the_right_ones() {
    let mut text = Reason::new();
    for goal in ["101", "-1"] {
        assert_eq!(opening(goal, &mut Report::new(&mut text)), Err(Refused));
        assert_eq!(text.as_str(), "valve opens 0 to 100 %");
    }
    assert_eq!(opening("12.5", &mut Report::new(&mut text)), Ok(12.5));
}

/// A valve on a bus, which moves by 10 % each time that it is asked.
struct Bus {
    goal: Rc<Cell<u8>>,
    at: u8,
}

impl i2c::ErrorType for Bus {
    type Error = Infallible;
}

impl I2c for Bus {
    async fn transaction(
        &mut self,
        _: u8,
        operations: &mut [i2c::Operation<'_>],
    ) -> Result<(), Infallible> {
        for operation in operations {
            match operation {
                i2c::Operation::Write([0, goal]) => self.goal.set(*goal),
                i2c::Operation::Read(bytes) => {
                    self.at = self.goal.get().min(self.at + 10);
                    bytes.fill(self.at);
                }
                i2c::Operation::Write(_) => {}
            }
        }
        Ok(())
    }
}

struct NoDelay;

impl DelayNs for NoDelay {
    async fn delay_ns(&mut self, _: u32) {}
}

#[test]
fn the_valve_on_the_bus_opens() {
    let goal = Rc::new(Cell::new(9));
    let bus = Bus {
        goal: goal.clone(),
        at: 0,
    };
    let mut valve = BusValve {
        bus,
        delay: NoDelay,
    };
    let slot = Slot::<BusValve<Bus, NoDelay>>::new(Offer::new("valve").with_range(0.0, 100.0, "%"));
    let mut component = slot.component();
    let clock = || Instant::ZERO;
    let mut driver = pin!(slot.run(&mut valve, clock));
    let mut turn = || {
        let polled = driver
            .as_mut()
            .poll(&mut Context::from_waker(Waker::noop()));
        assert!(polled.is_pending());
    };
    turn();
    assert_eq!(goal.get(), 0, "safe before its first task");
    let mut text = Reason::new();
    component
        .start(Instant::ZERO, "40", &mut Report::new(&mut text))
        .unwrap();
    turn();
    let run = component.poll(Instant::ZERO, &mut Report::new(&mut text));
    assert_eq!((run, text.as_str()), (Run::Completed, "40"));
}

/// Lines without their indentation and without empty ones.
fn lines(text: &str) -> Vec<&str> {
    let lines = text.lines().map(str::trim);
    lines.filter(|line| !line.is_empty()).collect()
}

#[test]
fn each_block_of_the_guide_stands_here() {
    let source = lines(include_str!("guide.rs"));
    let blocks: Vec<&str> = GUIDE.split("```rust\n").skip(1).collect();
    assert!(blocks.len() >= 5);
    for block in blocks {
        let (code, _) = block.split_once("```").unwrap();
        for part in code.split("// …\n") {
            let part = lines(part);
            let found = source.windows(part.len()).any(|window| window == part);
            assert!(found, "not in guide.rs:\n{}", part.join("\n"));
        }
    }
    assert!(GUIDE.lines().count() <= 150);
}
