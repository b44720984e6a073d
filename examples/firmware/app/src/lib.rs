//! The firmware of a desk robot, the same on each board: a gripper on a servo, a stage on a stepper with a limit switch,
//! and a lamp. A board provides pins, a serial port and a clock.
#![no_std]

#[cfg(feature = "tcp")]
pub mod tcp;

use core::convert::Infallible;

use embedded_hal::digital::{InputPin, OutputPin};
use embedded_hal::pwm::SetDutyCycle;
use embedded_io::Write;
use ztl_mcu::components::{
    DigitalOutput, DigitalOutputConfig, Scale, Servo, ServoConfig, StepMotor, Stepper,
    StepperConfig, Switch,
};
use ztl_mcu::describe::{DescribeAll, Described};
use ztl_mcu::pump::Pump;
use ztl_mcu::shared::{ReceiveQueue, StopFlag};
use ztl_mcu::zmtp::{Line, Server};
use ztl_mcu::{Components, Identity, Instant, Node};

/// Bytes received by the board's serial port.
pub static RECEIVED: ReceiveQueue<128> = ReceiveQueue::new();

/// The emergency stop, which the board's button raises.
pub static STOP: StopFlag = StopFlag::new();

#[cfg(feature = "defmt")]
static LOG: ztl_mcu::log::LogQueue<256> = ztl_mcu::log::LogQueue::new();
#[cfg(feature = "defmt")]
ztl_mcu::defmt_logger!(LOG);

/// A gripper that opens by 90 degrees.
const GRIPPER: ServoConfig = ServoConfig {
    range: (0, 90),
    speed: 90,
    acceleration: 360,
    ..ServoConfig::DEFAULT
};

/// A slide of 200 mm.
const STAGE: StepperConfig = StepperConfig {
    scale: Scale::new(40, 1, "mm"),
    range: (0, 200),
    speed: 1600,
    acceleration: 8000,
    home_speed: 800,
    ..StepperConfig::DEFAULT
};

/// Maximum number of tasks, and longest frame.
const TASKS: usize = 4;
const FRAME: usize = 256;

/// Minimum time until the next turn for which the processor sleeps. A tick of its clock wakes it.
const SLEEP_US: u64 = 2000;

/// The pins of the robot.
#[derive(Debug)]
pub struct Pins<P, S, D, L, O> {
    /// The gripper's servo: a PWM output of 50 Hz.
    pub gripper: P,
    /// Step input of the stage's driver.
    pub step: S,
    /// Direction input of the stage's driver.
    pub direction: D,
    /// Limit switch: low when the stage is at its low end.
    pub limit: L,
    /// The lamp.
    pub lamp: O,
}

/// The serial port, clock and buttons of a board.
pub trait Board {
    /// Its serial port. `write` takes what fits, possibly nothing, so that no motion waits for it.
    type Port: Write<Error = Infallible>;

    /// The serial port.
    fn port(&mut self) -> &mut Self::Port;

    /// The time since the reset.
    fn now(&mut self) -> Instant;

    /// Whether to end the emergency stop: its button is released, and the resume button was pressed.
    fn may_resume(&mut self) -> bool;

    /// Waits for an interrupt. The clock must tick at least every millisecond.
    fn sleep(&mut self);
}

/// The node of the robot. `boot` differs from reset to reset.
// Not inlined, so that only the node stays on the stack.
#[inline(never)]
fn robot(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
) -> Node<'static, impl Components, TASKS, FRAME> {
    node(boot, components(pins))
}

/// The same with components that say what they are.
#[inline(never)]
fn described_robot(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
) -> Node<'static, impl Components, TASKS, FRAME> {
    node(boot, Described(components(pins)))
}

#[inline(always)]
fn node<C: Components>(boot: u32, components: C) -> Node<'static, C, TASKS, FRAME> {
    #[cfg(feature = "defmt")]
    defmt::info!("desk robot started, boot {=u32:x}", boot);
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), boot);
    Node::new(identity, components)
}

/// The components of the robot.
fn components(
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
) -> impl Components + DescribeAll {
    let stage = StepMotor::new(pins.step, pins.direction, &STAGE)
        .with_low_limit(Switch::active_low(pins.limit));
    (
        Servo::new("gripper", pins.gripper, GRIPPER),
        Stepper::new("stage", stage, STAGE),
        DigitalOutput::new("lamp", pins.lamp, DigitalOutputConfig::DEFAULT),
    )
}

fn pump() -> Pump<'static> {
    let pump = Pump::new().with_stop(&STOP);
    #[cfg(feature = "defmt")]
    let pump = pump.with_log(&LOG);
    pump
}

/// Runs forever.
pub fn run(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
    board: &mut impl Board,
) -> ! {
    run_node(robot(boot, pins), board)
}

/// The same with components that say what they are: `ztl describe` shows it.
pub fn run_described(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
    board: &mut impl Board,
) -> ! {
    run_node(described_robot(boot, pins), board)
}

#[inline(always)]
fn run_node(mut node: Node<'static, impl Components, TASKS, FRAME>, board: &mut impl Board) -> ! {
    let pump = pump();
    let mut stopped = false;
    loop {
        let now = board.now();
        // Neither half of the port can fail.
        let due = pump.turn_split(&mut node, &mut &RECEIVED, board.port(), now);
        if node.is_stopped() && board.may_resume() {
            node.clear_stop();
        }
        if node.is_stopped() != stopped {
            stopped = !stopped;
            #[cfg(feature = "defmt")]
            match stopped {
                true => defmt::warn!("emergency stop"),
                false => defmt::info!("emergency stop is over"),
            }
        }
        let due = due.unwrap_or(now);
        if due.as_micros().saturating_sub(now.as_micros()) > SLEEP_US {
            board.sleep();
        }
    }
}

/// The robot as a server for up to `PEERS` ZeroMQ clients, without a gateway.
pub fn server<const PEERS: usize>(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
) -> Server<'static, impl Components, PEERS, TASKS, FRAME, TASKS> {
    let identity = Identity::new("desk", env!("CARGO_PKG_VERSION"), boot);
    Server::new("/lab", identity, components(pins))
}

/// Begins the emergency stop when its button was pressed, and ends it when the board allows it.
pub fn poll_stop<C: Components, const PEERS: usize>(
    server: &mut Server<'_, C, PEERS, TASKS, FRAME, TASKS>,
    board: &mut impl Board,
    now: Instant,
) {
    if STOP.take() {
        server.stop_everything(now);
    }
    if server.is_stopped() && board.may_resume() {
        server.clear_stop();
    }
}

/// Runs forever as a server for a ZeroMQ client on the serial port.
pub fn serve(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
    board: &mut impl Board,
) -> ! {
    let mut server = server::<1>(boot, pins);
    let mut line = Line::new();
    loop {
        let now = board.now();
        // Neither half of the port can fail.
        let due = line.turn(&mut server, &mut &RECEIVED, board.port(), now);
        poll_stop(&mut server, board, now);
        let due = due.unwrap_or(now);
        if due.as_micros().saturating_sub(now.as_micros()) > SLEEP_US {
            board.sleep();
        }
    }
}

/// Runs forever, as a future. `resume` becomes ready to end an emergency stop.
#[cfg(feature = "async")]
pub async fn run_async(
    boot: u32,
    pins: Pins<impl SetDutyCycle, impl OutputPin, impl OutputPin, impl InputPin, impl OutputPin>,
    rx: &mut impl embedded_io_async::Read,
    tx: &mut impl embedded_io_async::Write,
    mut delay: impl embedded_hal_async::delay::DelayNs,
    now: impl Fn() -> Instant,
    mut resume: impl AsyncFnMut(),
) -> ! {
    let mut node = robot(boot, pins);
    let pump = pump();
    loop {
        // Retries a failed port, so that running motions continue.
        let running = pump.run(&mut node, rx, tx, &mut delay, &now);
        if let embassy_futures::select::Either::Second(()) =
            embassy_futures::select::select(running, resume()).await
        {
            node.clear_stop();
            #[cfg(feature = "defmt")]
            defmt::info!("emergency stop is over");
        }
    }
}
