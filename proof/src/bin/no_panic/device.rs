//! A device: a node, its components, and a server for ZeroMQ clients.

use core::convert::Infallible;
use core::hint::black_box;
use core::sync::atomic::AtomicU8;

use embedded_io::{ErrorType, Read, ReadReady, Write};
use ztl_core::Instant;
use ztl_mcu::components::{
    DigitalInput, DigitalInputConfig, DigitalOutput, DigitalOutputConfig, Servo, ServoConfig,
    StepMotor, Stepper, StepperConfig, Switch,
};
use ztl_mcu::describe::{Describe, DescribeAll};
use ztl_mcu::driver::{Driver, Failed, Progress, Slot};
use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
use ztl_mcu::log::LogSource;
use ztl_mcu::parameters::{SaveError, Storage, Text, Tunable, TuneAll};
use ztl_mcu::pump::Pump;
use ztl_mcu::shared::{EndFlag, LatestReading, LogQueue, ReceiveQueue, StopFlag};
use ztl_mcu::update::{Firmware, Receiving, SelfTest, UpdateError, Updater, Verification};
use ztl_mcu::zmtp::{Connection, Peer, Server, Socket};
use ztl_mcu::{
    Component, Components, Latest, Node, Queued, Reading, Refused, Report, Run, parameters,
    parse_goal,
};
use ztl_proof::{AnyPin, now, receive, send};

use crate::{any, room};

parameters! {
    /// One of each kind.
    pub(crate) struct Settings {
        on: bool = Parameter::<bool>::new(false);
        number: u32 = Parameter::<u32>::new(1).range(1, 9);
        whole: i32 = Parameter::<i32>::new(-1);
        gain: f32 = Parameter::<f32>::new(1.0).range(0.0, 10.0).unit("1/s").about("of the loop");
        label: Text<16> = Parameter::<Text<16>>::new("node");
    }
}

/// Stores and returns anything.
pub(crate) struct Eeprom;

impl Storage for Eeprom {
    fn read(&mut self, key: u64, buffer: &mut [u8]) -> Result<Option<usize>, SaveError> {
        black_box(key);
        buffer.fill_with(receive);
        Ok(black_box(Some(buffer.len())))
    }

    fn write(&mut self, key: u64, bytes: &[u8]) -> Result<(), SaveError> {
        black_box((key, bytes));
        match any() {
            0 => Err(SaveError::Failed),
            _ => Ok(()),
        }
    }
}

/// Takes, verifies and confirms anything, or not.
pub(crate) struct AnyUpdater;

fn perhaps<T>(value: T) -> Result<T, UpdateError> {
    match UpdateError::from_code(receive()) {
        UpdateError::Unknown(_) => Ok(value),
        error => Err(error),
    }
}

impl Updater for AnyUpdater {
    fn firmware(&self) -> Firmware<'_> {
        Firmware {
            board: black_box("board"),
            version: black_box("1.0.0"),
            confirmed: receive() == 0,
            trial_ms: any(),
            self_test: black_box(Some(SelfTest {
                component: receive(),
                goal: black_box("test"),
            })),
        }
    }

    fn begin(&mut self, manifest: &[u8], downgrade: bool) -> Result<Receiving, UpdateError> {
        black_box((manifest, downgrade));
        perhaps(Receiving {
            length: any(),
            offset: any(),
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), UpdateError> {
        black_box((offset, bytes));
        perhaps(())
    }

    fn verify(&mut self) -> Result<Verification, UpdateError> {
        perhaps(black_box(Verification::Done))
    }

    fn restart(&mut self) {
        black_box(&mut *self);
    }

    fn confirm(&mut self) -> Result<(), UpdateError> {
        perhaps(())
    }
}

/// The ready components, with arbitrary settings, and one with long results. A check requires every one of them here.
pub(crate) fn ready_parts() -> impl Components + DescribeAll + TuneAll {
    let slide = black_box(StepperConfig::DEFAULT);
    let motor = StepMotor::new(AnyPin, AnyPin, &slide)
        .with_enable(AnyPin)
        .with_low_limit(Switch::active_low(AnyPin))
        .with_high_limit(Switch::active_high(AnyPin));
    (
        Servo::new("pan", AnyPin, black_box(ServoConfig::DEFAULT)),
        Stepper::new("slide", motor, slide),
        DigitalOutput::new("lamp", AnyPin, black_box(DigitalOutputConfig::DEFAULT)),
        DigitalInput::new("button", AnyPin, black_box(DigitalInputConfig::DEFAULT)),
        Part::new(),
    )
}

pub(crate) fn run_node<C: Components, const TASKS: usize, const FRAME: usize>(
    node: &mut Node<'_, C, TASKS, FRAME>,
    input: &[u8],
) {
    node.handle_bytes(now(), input);
    node.handle_timeout(now());
    let mut buffer = room();
    let count = node.poll_transmit(now(), &mut buffer);
    send(buffer.get(..count).unwrap_or_default());
    black_box(node.poll_timeout(now()));
    match receive() {
        0 => node.stop_everything(now()),
        1 => node.clear_stop(),
        _ => {}
    }
    black_box((node.counters(), node.is_stopped(), node.link(now())));
    black_box(node.components_mut());
    for &byte in input {
        RECEIVED.push(byte);
    }
    RECEIVED.push_slice(input);
    RECEIVED.push_ring(&RING, &mut (any() as usize), any() as usize);
    LOG.push(input);
    STOP.raise();
    END.report();
    black_box((RECEIVED.lost(), LOG.lost(), STOP.is_raised()));
    black_box((END.is_reached(), END.take()));
    let pump = Pump::new().with_stop(&STOP).with_log(&LOG);
    let _ = black_box(Pump::new().turn(node, &mut Line, now()));
    let _ = black_box(pump.turn_split(node, &mut &RECEIVED, &mut Line, now()));
}

/// A server for ZeroMQ clients, which connect and disconnect in any order.
pub(crate) fn run_server<C: Components>(server: &mut Server<'_, C, 3, 4, 256, 4>, input: &[u8]) {
    let peer = server.vacant().unwrap_or(Peer(receive()));
    match receive() {
        0 => server.open(now(), peer),
        1 => server.close(peer),
        2 => server.stop_everything(now()),
        3 => server.clear_stop(),
        _ => {}
    }
    black_box(server.handle_bytes(now(), Peer(receive()), input));
    server.handle_timeout(now());
    send(server.transmit_buf(Peer(receive())));
    server.consume(Peer(receive()), any() as usize);
    black_box((
        server.is_open(peer),
        server.fault(peer),
        server.is_stopped(),
    ));
    black_box((server.poll_timeout(now()), server.components_mut().count()));
}

pub(crate) fn run_connection<S: Socket, B: AsRef<[u8]> + AsMut<[u8]>>(
    connection: &mut Connection<S, B>,
    input: &[u8],
) {
    match receive() {
        0 => connection.open(now()),
        1 => connection.close(),
        2 => connection.hold(),
        3 => connection.discard(),
        _ => {}
    }
    black_box(connection.handle_bytes(now(), input));
    connection.handle_timeout(now());
    if let Some(message) = connection.message() {
        black_box((message.envelope(), message.content));
        black_box(message.envelope.count());
    }
    connection.reply(&mut |sink| sink.put(input));
    black_box(connection.request(&[input, input], &mut |sink| sink.put(input)));
    send(connection.transmit_buf());
    connection.consume(any() as usize);
    black_box((
        connection.is_open(),
        connection.is_ready(),
        connection.fault(),
    ));
    black_box(connection.poll_timeout());
}

pub(crate) static RECEIVED: ReceiveQueue<64> = ReceiveQueue::new();
static RING: [AtomicU8; 32] = [const { AtomicU8::new(0) }; 32];
static LOG: LogQueue<100> = LogQueue::new();
static STOP: StopFlag = StopFlag::new();
static END: EndFlag = EndFlag::new();

/// A stream with arbitrary data.
pub(crate) struct Line;

impl ErrorType for Line {
    type Error = Infallible;
}

impl Read for Line {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        buffer.fill_with(receive);
        Ok(any() as usize)
    }
}

impl ReadReady for Line {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(receive() != 0)
    }
}

impl Write for Line {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        send(bytes);
        Ok(any() as usize)
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// A component with arbitrary behaviour.
pub(crate) struct Part {
    latest: Latest<16>,
    queued: Queued<3, 16>,
}

impl Part {
    pub(crate) const fn new() -> Self {
        Self {
            latest: Latest::new(),
            queued: Queued::new(),
        }
    }
}

/// The place of a driver that another task of the firmware runs.
pub(crate) static SLOT: Slot<'static, Motor> = Slot::new(Offer::new("motor"));

pub(crate) struct Motor;

impl Driver for Motor {
    fn check(goal: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        black_box(goal);
        black_box(Ok(()))
    }

    async fn run(&mut self, _: &str, _: Progress<'_>) -> Result<(), Failed> {
        Err(Failed)
    }

    async fn make_safe(&mut self) {}

    fn poll_reading(_: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let _ = black_box(SPEED.set(buffer));
        SPEED.take(receive(), buffer)
    }
}

static SPEED: LatestReading<16> = LatestReading::new();

impl Describe for Part {}

impl Tunable for Part {}

impl Component for Part {
    fn offer(&self) -> Offer<'_> {
        Offer {
            name: black_box("part"),
            goal: GoalShape {
                range: Some((f32::from_bits(any()), f32::from_bits(any()))),
                unit: black_box("unit"),
                words: black_box("words"),
            },
            busy: black_box(Busy::Queue(1)),
            loss: black_box(Loss::CarryOn),
            topics: black_box("one two"),
        }
    }

    fn check(&self, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        why.text(black_box(goal));
        black_box(parse_goal::<(f32, i8, [bool; 2])>(goal, why)?);
        black_box(Err(Refused))
    }

    fn start(&mut self, _now: Instant, goal: &str, why: &mut Report<'_>) -> Result<(), Refused> {
        self.check(goal, why)
    }

    fn poll(&mut self, _now: Instant, report: &mut Report<'_>) -> Run {
        report.text(black_box("text"));
        report.number(f32::from_bits(any()), receive());
        let _ = black_box(report.value(
            &(any(), f32::from_bits(any()), black_box("text")),
            receive(),
        ));
        black_box(Run::Running)
    }

    fn abort(&mut self, _now: Instant) {}

    fn make_safe(&mut self, _now: Instant) {}

    fn poll_timeout(&self, now: Instant) -> Instant {
        black_box(now)
    }

    fn next_tick(&self) -> Instant {
        black_box(now())
    }

    fn result(&self) -> &str {
        black_box("result")
    }

    fn poll_reading(&mut self, _now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let mut room = room();
        let _ = black_box(self.latest.set(&room));
        let _ = black_box(self.queued.push(&room));
        black_box((self.latest.take(receive(), &mut room), self.queued.lost()));
        black_box(self.queued.take(receive(), &mut room));
        buffer.fill_with(receive);
        let (topic, len) = (receive(), any() as usize);
        black_box(Some(Reading { topic, len }))
    }
}
