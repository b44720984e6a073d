//! Calls everything that bytes from outside can reach. It links only if no panic is reachable.
//!
//! The panic handler calls a function that does not exist. If the optimiser proves that no panic is reachable, it removes
//! the handler, and the linker does not need that function. So linking is the proof.
//!
//! `Pump::run` and `Slot::run` are left out, because every `async` block panics if it is polled after its end. No input makes an executor do
//! that, but the optimiser cannot know.
#![no_std]
#![no_main]

mod device;

use core::hint::black_box;
use core::panic::PanicInfo;
use core::time::Duration;

use serde::de::{IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use ztl_core::client::Client;
use ztl_core::dispatcher::{self, Config, Dispatcher, TaskEvent};
use ztl_core::envelope::{ClientId, Envelope};
use ztl_core::integer::Integer;
use ztl_core::lifecycle::{Event, Request};
use ztl_core::link::{self, Decoder, Frame, LinkId};
use ztl_core::manifest::{Manifest, Version};
use ztl_core::memory::Fixed;
use ztl_core::message::Message;
use ztl_core::reply::Reply;
use ztl_core::repr::put_quoted;
use ztl_core::sink::{SliceSink, put_decimal, put_fixed};
use ztl_core::spec::TaskSpec;
use ztl_core::tasks::{Task, TaskRules, TaskTable, Tasks};
use ztl_core::time::earliest;
use ztl_core::{State, TaskId, base64, goal};
use ztl_mcu::bus::OnBus;
use ztl_mcu::describe::Described;
use ztl_mcu::parameters::Tuned;
use ztl_mcu::update::Updatable;
use ztl_mcu::zmtp::{Connection, Dealer, Line as ZmtpLine, Rep, Req, Server};
use ztl_mcu::{Acting, Component, Identity, Node};
use ztl_proof::{FIRST, now, receive};

use device::{
    AnyUpdater, Eeprom, Line, Part, RECEIVED, SLOT, Settings, ready_parts, run_connection,
    run_node, run_server,
};

#[cfg(not(feature = "explain"))]
#[panic_handler]
fn on_panic(_: &PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        /// Not defined anywhere.
        safe fn a_panic_is_reachable() -> !;
    }
    a_panic_is_reachable()
}

/// Keeps the positions of all panics in the image.
#[cfg(feature = "explain")]
#[panic_handler]
fn on_panic(info: &PanicInfo<'_>) -> ! {
    loop {
        black_box(info.location());
    }
}

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    let identity = || Identity::new(black_box("node"), black_box("1"), any());
    let mut parts = [Part::new(), Part::new()];
    let [one, two] = &mut parts;
    let mut components: [&mut dyn Component; 2] = [one, two];
    let mut node = Node::<_, 4, 128>::new(identity(), components.as_mut_slice());
    // Frames longer than a COBS block.
    let mut long_framed =
        Node::<_, 1, 600>::new(identity(), (Part::new(), Part::new(), SLOT.component()));
    let tuned = Tuned::new(ready_parts()).with_firmware(Settings::default());
    let tuned = Described(tuned.load::<_, 5>(Eeprom));
    let acting = OnBus::new(Acting::new(tuned), 1 << 63, 7);
    let updatable = Updatable::new(acting, AnyUpdater);
    let mut ready_node = Node::<_, 2, 128>::new(identity(), updatable);
    let mut server = Server::<_, 3, 4, 256, 4>::new("/one", identity(), ready_parts());
    let mut reply = Connection::<Rep, _>::new(room());
    let mut ask = Connection::<Req, _>::new([0; 300]);
    let mut deal = Connection::<Dealer, _>::new([0; 128]);
    let mut zmtp_line = ZmtpLine::new();
    let mut decoder = Decoder::<600>::new();
    let mut table = TaskTable::new();
    let config = Config::new(id(), any());
    let mut dispatcher = Dispatcher::new(Memory::new(["/one", "/two"]), config);
    let mut client = Client::new(ClientId([receive(); 16]), Duration::from_secs(2));
    loop {
        // In any state, as far as the compiler knows.
        black_box((&mut node, &mut long_framed, &mut ready_node, &mut decoder));
        black_box((&mut table, &mut dispatcher, &mut client));
        black_box((&mut server, &mut zmtp_line));
        black_box((&mut reply, &mut ask, &mut deal));
        let mut received = [0; 512];
        received.fill_with(receive);
        // Of any length, as far as the compiler knows.
        let input = black_box(received.as_slice());
        let text = core::str::from_utf8(input).unwrap_or_default();
        #[cfg(feature = "broken")]
        indexed(input);
        messages(input, text);
        manifests(input, text);
        specs(text);
        numbers(text);
        codes();
        frames(input, &mut decoder);
        bodies(input);
        goals(text);
        tasks(&mut table, text);
        dispatch(&mut dispatcher, input, text);
        run_client(&mut client, input, text);
        black_box(Node::<[Part; 1], 4, 128>::fits(&Part::new().offer()));
        run_node(&mut node, input);
        run_node(&mut long_framed, input);
        run_node(&mut ready_node, input);
        let text = core::str::from_utf8(input).unwrap_or_default();
        if let Ok(task) = ready_node.start_here(now(), receive(), text) {
            black_box(ready_node.abort_here(now(), task));
        }
        black_box(ready_node.report_event(now(), text));
        black_box((
            ready_node.events_lost(),
            ready_node.components().components.address(),
        ));
        run_server(&mut server, input);
        let _ = black_box(zmtp_line.turn(&mut server, &mut &RECEIVED, &mut Line, now()));
        let _ = black_box(zmtp_line.turn(&mut server, &mut Line, &mut Line, now()));
        run_connection(&mut reply, input);
        run_connection(&mut ask, input);
        run_connection(&mut deal, input);
    }
}

/// A panic that the proof must detect.
#[cfg(feature = "broken")]
fn indexed(input: &[u8]) {
    #[expect(clippy::indexing_slicing, reason = "the panic to detect")]
    black_box(input[usize::from(receive())]);
}

fn messages(input: &[u8], text: &str) {
    if let Ok(message) = black_box(Message::parse(input)) {
        let _ = black_box((message.code(), message.number(), message.encoded_len()));
        let _ = black_box(message.encode_into(&mut room()));
    }
    let message = black_box(Message {
        scope: text,
        state: text,
        id: text,
        payload: text,
    });
    let _ = black_box(message.encode_into(&mut room()));
    if let Err(error) = Message::parse(input) {
        black_box(error.scope());
    }
}

fn manifests(input: &[u8], text: &str) {
    if let Ok(parsed) = black_box(Manifest::parse(input)) {
        let _ = black_box(parsed.manifest.head());
    }
    let _ = black_box(Version::parse(text));
}

fn specs(text: &str) {
    let mut buffer = room();
    let _ = black_box(TaskSpec::split(text));
    let _ = black_box(base64::decode(text.as_bytes(), &mut buffer));
    if let Ok(spec) = black_box(TaskSpec::decode(text, &mut buffer)) {
        black_box(spec.encoded_len());
        let _ = black_box(spec.encode_into(&mut room()));
        let mut room = room();
        let mut sink = SliceSink::new(&mut room);
        spec.put_initiated(id(), &mut sink);
        let _ = black_box(sink.finish());
    }
}

fn numbers(text: &str) {
    let mut room = room();
    let mut sink = SliceSink::new(&mut room);
    if let Ok(integer) = black_box(Integer::parse(text)) {
        black_box(integer.value());
        integer.put(&mut sink);
    }
    put_decimal(&mut sink, any());
    put_fixed(&mut sink, f32::from_bits(any()), receive());
    put_quoted(text, &mut sink);
    let _ = black_box(sink.finish());
}

fn codes() {
    let code = black_box(i64::from(any()));
    black_box(Request::from_code(code).map(Request::code));
    if let Some(state) = State::from_code(code) {
        for event in events() {
            black_box(state.after(event));
        }
        black_box(state.name());
    }
    let later = now() + Duration::from_micros(u64::from(any()) << 32 | u64::from(any()));
    black_box((earliest(Some(later), Some(now())), later.since(now())));
    black_box(TaskId::new(any()).and_then(TaskId::next));
}

fn frames(input: &[u8], decoder: &mut Decoder<600>) {
    for &byte in input {
        if !matches!(black_box(decoder.push(byte)), Ok(true)) {
            continue;
        }
        if let Ok((_, frame)) = black_box(decoder.frame(&[any(), any()])) {
            let _ = black_box(link::encode(any(), &frame, &mut room()));
        }
    }
    black_box((link::session_key(any(), any()), link::next_seq(receive())));
}

fn bodies(input: &[u8]) {
    if let Ok(body) = black_box(link::Body::parse(input)) {
        if let link::Body::Welcome(welcome) = body {
            welcome.held.iter().for_each(|id| {
                black_box(id);
            });
        }
        let frame = Frame {
            addr: receive(),
            seq: receive(),
            body,
        };
        let _ = black_box(link::encode(any(), &frame, &mut room()));
    }
}

/// Uses every type that a goal can contain.
#[derive(Clone, Deserialize, Serialize)]
struct Everything<'a> {
    yes: bool,
    small: i8,
    large: u64,
    single: f32,
    double: f64,
    letter: char,
    #[serde(borrow)]
    text: &'a str,
    may_be: Option<(u16, i32)>,
    list: [f32; 3],
    mode: Mode,
    nothing: (),
    wrapped: Wrapped,
}

#[derive(Clone, Deserialize, Serialize)]
enum Mode {
    Off,
    Speed(f32),
    Range(i64, i64),
    Pose { x: f32, y: f32 },
}

#[derive(Clone, Deserialize, Serialize)]
struct Wrapped(u32);

/// A goal of any type, by `deserialize_any`.
struct Whatever;

impl<'de> Deserialize<'de> for Whatever {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(Self)
    }
}

impl<'de> Visitor<'de> for Whatever {
    type Value = Self;

    fn expecting(&self, _: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        Ok(())
    }

    fn visit_bool<E>(self, value: bool) -> Result<Self, E> {
        black_box(value);
        Ok(self)
    }

    fn visit_i64<E>(self, value: i64) -> Result<Self, E> {
        black_box(value);
        Ok(self)
    }

    fn visit_u64<E>(self, value: u64) -> Result<Self, E> {
        black_box(value);
        Ok(self)
    }

    fn visit_f64<E>(self, value: f64) -> Result<Self, E> {
        black_box(value);
        Ok(self)
    }

    fn visit_str<E>(self, value: &str) -> Result<Self, E> {
        black_box(value);
        Ok(self)
    }

    fn visit_unit<E>(self) -> Result<Self, E> {
        Ok(self)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self, A::Error> {
        while items.next_element::<Self>()?.is_some() {}
        Ok(self)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut items: A) -> Result<Self, A::Error> {
        while items.next_entry::<Self, Self>()?.is_some() {}
        Ok(self)
    }
}

fn goals(text: &str) {
    let mut scratch = room();
    let everything = black_box(goal::from_str_with::<Everything<'_>>(text, &mut scratch));
    let _ = black_box(goal::from_str::<IgnoredAny>(text).is_ok());
    let _ = black_box(goal::from_str_with::<Whatever>(text, &mut room()).is_ok());
    let _ = black_box(goal::from_str::<&str>(text));
    if let Ok(everything) = everything {
        let _ = black_box(goal::to_slice(&everything, &mut room()));
        let fixed = goal::Fixed(receive());
        let _ = black_box(goal::to_slice_with(&everything, fixed, &mut room()));
    }
}

/// The table of tasks.
fn tasks(table: &mut TaskTable<LinkId, u8, 4, 16>, text: &str) {
    let id = LinkId(any());
    let _ = black_box(table.admit(id, Task::new(receive())));
    for event in events() {
        black_box(table.apply(now(), LinkId(any()), event, Some(text)));
    }
    black_box(table.progress(id, text));
    table.forget_until(now());
    for (id, task) in table.iter() {
        black_box((id, task.extra));
    }
    black_box((table.get(id).is_some(), table.len(), table.is_empty()));
    black_box(table.oldest_end());
}

type Memory = Fixed<u8, 2, 8, 32, 4>;

fn dispatch(dispatcher: &mut Dispatcher<Memory>, input: &[u8], text: &str) {
    let mut out = |peer: u8, reply: &Reply<'_>| {
        let mut room = room();
        let mut sink = SliceSink::new(&mut room);
        reply.put(&mut sink);
        black_box((peer, sink.finish().ok(), reply.state(), reply.task()));
    };
    let envelope = Envelope::parse(input, text.as_bytes());
    let body = match receive() {
        0 => dispatcher::Body::Several,
        _ => dispatcher::Body::One(input),
    };
    black_box(dispatcher.handle_request(now(), receive(), black_box(envelope), body, &mut out));
    let event = match receive() {
        0 => TaskEvent::Accepted { reply: text },
        1 => TaskEvent::Rejected { reason: text },
        2 => TaskEvent::Threw { message: text },
        3 => TaskEvent::Progress { text },
        4 => TaskEvent::Completed { result: text },
        5 => TaskEvent::Failed { reason: text },
        6 => TaskEvent::Aborted { result: text },
        _ => TaskEvent::AbortRejected,
    };
    dispatcher.handle_event(now(), id(), event, &mut out);
    dispatcher.handle_timeout(now(), &mut out);
    black_box(dispatcher.poll_timeout());
}

fn run_client(client: &mut Client, input: &[u8], text: &str) {
    let mut room = room();
    let mut sink = SliceSink::new(&mut room);
    let envelope = match receive() {
        0 => Some(client.request(now(), Request::Init, text, None, text, &mut sink)),
        1 => {
            let id = Integer::parse(text).ok();
            Some(client.request(now(), Request::Abort, text, id, text, &mut sink))
        }
        2 => Some(client.probe(now(), &mut sink)),
        _ => client.outcome(now(), &mut sink),
    };
    let _ = black_box(sink.finish());
    if let Some(envelope) = black_box(envelope) {
        black_box(envelope.frames());
        black_box(client.handle_reply(envelope, input, input));
    }
    black_box((
        client.handle_timeout(now()),
        client.poll_timeout(),
        client.server(),
    ));
}

fn events() -> [Event; 5] {
    black_box([
        Event::Accept,
        Event::Reject,
        Event::Complete,
        Event::Fail,
        Event::Abort,
    ])
}

/// An arbitrary id.
fn id() -> TaskId {
    TaskId::new(any()).unwrap_or(FIRST)
}

/// An arbitrary number.
fn any() -> u32 {
    u32::from_le_bytes([receive(), receive(), receive(), receive()])
}

/// A buffer of arbitrary length, as far as the compiler knows.
fn room() -> Room {
    Room([0; 256])
}

struct Room([u8; 256]);

impl AsRef<[u8]> for Room {
    fn as_ref(&self) -> &[u8] {
        self
    }
}

impl AsMut<[u8]> for Room {
    fn as_mut(&mut self) -> &mut [u8] {
        self
    }
}

impl core::ops::Deref for Room {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        black_box(self.0.as_slice())
    }
}

impl core::ops::DerefMut for Room {
    fn deref_mut(&mut self) -> &mut [u8] {
        black_box(self.0.as_mut_slice())
    }
}
