//! The image whose size is recorded: a small server that moves a base.
//!
//! Requests arrive over the line, one per frame. They pass through everything that a server in firmware
//! needs: the dispatcher with two scopes and eight tasks, the task specification, and a goal of three numbers
//! that is parsed into a struct.
#![no_std]
#![no_main]

use core::panic::PanicInfo;

use serde::Deserialize;
use ztl_core::dispatcher::{Action, Body, Config, Dispatcher, TaskEvent};
use ztl_core::envelope::Envelope;
use ztl_core::memory::Fixed;
use ztl_core::reply::Reply;
use ztl_core::{TaskId, TaskSpec, goal};
use ztl_proof::{FIRST, Room, now, receive, send};

/// Two scopes; eight tasks with texts of 32 bytes; four held replies. There is one client.
type Server = Dispatcher<Fixed<(), 2, 8, 32, 4>>;

static SERVER: Room<Server> = Room::new();
static REQUEST: Room<[u8; 256]> = Room::new();

/// Where the base should go.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Pose {
    x: f32,
    y: f32,
    turn: f32,
}

/// Never called: `cargo xtask test --only proof` shows that no panic is reachable.
#[panic_handler]
fn on_panic(_: &PanicInfo<'_>) -> ! {
    loop {
        core::hint::spin_loop();
    }
}

#[unsafe(no_mangle)]
extern "C" fn main() -> ! {
    let boot = u32::from(receive());
    let first = TaskId::new(boot.wrapping_mul(1 << 20)).unwrap_or(FIRST);
    let server = Server::new(Fixed::new(["/base", "/lamp"]), Config::new(first, boot));
    // SAFETY: `main` is called once, and fills each room once.
    let (server, request) = unsafe { (SERVER.fill(server), REQUEST.fill([0; 256])) };
    loop {
        if let Some((envelope, body)) = read_request(request) {
            serve(server, envelope, body);
        }
        server.handle_timeout(now(), &mut answer);
    }
}

/// Reads three frames, each a length byte and its content: the envelope's two frames, and the body.
fn read_request(buffer: &mut [u8]) -> Option<(Option<Envelope>, &[u8])> {
    let (head, rest) = buffer.split_at_mut_checked(32)?;
    let (client, number) = head.split_at_mut_checked(20)?;
    let client = read_frame(client)?;
    let number = read_frame(number)?;
    let body = read_frame(rest)?;
    Some((Envelope::parse(client, number), body))
}

fn read_frame(buffer: &mut [u8]) -> Option<&[u8]> {
    let frame = buffer.get_mut(..usize::from(receive()))?;
    frame.fill_with(receive);
    Some(frame)
}

/// Not inlined, so that the symbol table shows the dispatcher's size.
#[inline(never)]
fn serve(server: &mut Server, envelope: Option<Envelope>, body: &[u8]) {
    let action = server.handle_request(now(), (), envelope, Body::One(body), &mut answer);
    let (id, event) = match action {
        Some(Action::Start { id, payload, .. }) => (id, start(payload)),
        Some(Action::Abort { id, .. }) => (id, TaskEvent::Aborted { result: "stopped" }),
        None => return,
    };
    server.handle_event(now(), id, event, &mut answer);
}

/// Not inlined, to show the size of specification and goal.
#[inline(never)]
fn start(payload: &str) -> TaskEvent<'static> {
    let mut buffer = [0; 128];
    let Ok(spec) = TaskSpec::decode(payload, &mut buffer) else {
        return TaskEvent::Rejected {
            reason: "the task cannot be read",
        };
    };
    if spec.component != "base" {
        return TaskEvent::Rejected {
            reason: "there is one component: base",
        };
    }
    let Ok(pose) = goal::from_str::<Pose>(spec.goal) else {
        return TaskEvent::Rejected {
            reason: "the goal is x, y and turn",
        };
    };
    for value in [pose.x, pose.y, pose.turn] {
        send(&value.to_le_bytes());
    }
    TaskEvent::Accepted {
        reply: "on its way",
    }
}

fn answer((): (), reply: &Reply<'_>) {
    reply.put(&mut send);
}
