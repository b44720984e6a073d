//! The lamp of `smallest.rs` by postcard-rpc: its ping and schemas, and two endpoints, over the same serial port. Its size is
//! recorded, for comparison with `smallest.rs`.
#![no_std]
#![no_main]

use core::convert::Infallible;
use core::future::{Future, poll_fn};
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use board_support::clock::SysTick;
use board_support::panel::Lamp;
use cortex_m::Peripherals;
use cortex_m::peripheral::SCB;
use cortex_m_rt::entry;
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embedded_hal::digital::OutputPin;
use embedded_io::Write as _;
use embedded_io_async_06::{ErrorType, Read, Write};
use microbit::uart::Uart;
// For its feature.
use portable_atomic as _;
use postcard_rpc::header::VarHeader;
use postcard_rpc::server::impls::embedded_io_async_v0_6::{EioWireTx, WireStorage};
use postcard_rpc::server::{Dispatch, Server, WireSpawn};
use postcard_rpc::{define_dispatch, endpoints, topics};
use postcard_schema::Schema;
use serde::{Deserialize, Serialize};

/// What the lamp is to do.
#[derive(Serialize, Deserialize, Schema)]
pub struct Shine {
    /// Whether it is to shine.
    pub on: bool,
    /// For how long.
    pub millis: u32,
}

endpoints! {
    list = ENDPOINTS;
    omit_std = true;
    | EndpointTy | RequestTy | ResponseTy | Path |
    | ---------- | --------- | ---------- | ---- |
    | ShineEndpoint | Shine | bool | "desk/lamp" |
    | LitEndpoint | () | bool | "desk/lit" |
}

topics! {
    list = TOPICS_IN;
    direction = postcard_rpc::TopicDirection::ToServer;
    | TopicTy | MessageTy | Path |
    | ------- | --------- | ---- |
}

topics! {
    list = TOPICS_OUT;
    direction = postcard_rpc::TopicDirection::ToClient;
    | TopicTy | MessageTy | Path |
    | ------- | --------- | ---- |
}

/// Whether the lamp is on.
pub struct Lit(bool);

fn shine(lit: &mut Lit, _: VarHeader, shine: Shine) -> bool {
    lit.0 = shine.on && shine.millis > 0;
    let Ok(()) = match lit.0 {
        true => Lamp.set_high(),
        false => Lamp.set_low(),
    };
    lit.0
}

fn is_lit(lit: &mut Lit, _: VarHeader, (): ()) -> bool {
    lit.0
}

/// There is no task to spawn.
#[derive(Clone)]
pub struct NoSpawn;

impl WireSpawn for NoSpawn {
    type Error = Infallible;
    type Info = ();

    fn info(&self) -> &() {
        &()
    }
}

type Tx = EioWireTx<NoopRawMutex, Sender>;

define_dispatch! {
    app: App;
    spawn_fn: no_spawn;
    tx_impl: Tx;
    spawn_impl: NoSpawn;
    context: Lit;
    endpoints: {
        list: ENDPOINTS;
        | EndpointTy | kind | handler |
        | ---------- | ---- | ------- |
        | ShineEndpoint | blocking | shine |
        | LitEndpoint | blocking | is_lit |
    };
    topics_in: {
        list: TOPICS_IN;
        | TopicTy | kind | handler |
        | ------- | ---- | ------- |
    };
    topics_out: {
        list: TOPICS_OUT;
    };
}

/// The receiving half of the port.
pub struct Receiver;

impl ErrorType for Receiver {
    type Error = Infallible;
}

impl Read for Receiver {
    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        poll_fn(|_| match app::RECEIVED.take(buffer) {
            0 => Poll::Pending,
            count => Poll::Ready(Ok(count)),
        })
        .await
    }
}

/// The sending half of the port.
pub struct Sender(Uart);

impl ErrorType for Sender {
    type Error = Infallible;
}

impl Write for Sender {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        poll_fn(|_| match self.0.write(bytes) {
            Ok(0) => Poll::Pending,
            written => Poll::Ready(written),
        })
        .await
    }
}

static STORAGE: WireStorage<Receiver, Sender, NoopRawMutex, 128, 128> = WireStorage::new();

#[entry]
fn main() -> ! {
    let Some(core) = Peripherals::take() else {
        SCB::sys_reset()
    };
    let _clock = SysTick::<16_000>::start(core.SYST);
    let Some((rx, tx)) = STORAGE.init(Receiver, Sender(Uart::start())) else {
        SCB::sys_reset()
    };
    let mut buffer = [0; 128];
    let app = App::new(Lit(false), NoSpawn);
    let kind = app.min_key_len();
    let mut server = Server::new(tx, rx, buffer.as_mut_slice(), app, kind);
    loop {
        let mut running = pin!(server.run());
        let mut context = Context::from_waker(Waker::noop());
        while running.as_mut().poll(&mut context).is_pending() {}
    }
}

board_support::handlers!();
