//! A device on TCP whose line and power the test controls, and that records what really happened.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use ztl_mcu::bus::OnBus;
use ztl_mcu::link::{Loss, Offer};
use ztl_mcu::{Component, Components, Identity, Instant, Node, Refused, Report, Run};

/// Its address on a shared line, and the one of all nodes.
const ADDRESS: u8 = 3;
const ADDR_ALL: u8 = 255;

/// What a motor did for a goal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Deed {
    pub(crate) begun: u32,
    pub(crate) finished: u32,
}

#[derive(Debug, Default)]
pub(crate) struct World {
    /// By goal, for both motors.
    pub(crate) deeds: BTreeMap<String, Deed>,
    /// The device's output is lost.
    pub(crate) mute: bool,
    /// The device's input is lost.
    pub(crate) deaf: bool,
    /// Its plug is pulled.
    pub(crate) unplugged: bool,
    /// Its power fails for a moment.
    pub(crate) reset: bool,
    power_off: bool,
    /// Whether it has a connection, from which it may not have read all.
    pub(crate) connected: bool,
    /// Frames for all nodes of a shared line, such as those of a search. Some are not counted.
    pub(crate) searched: usize,
}

type Shared = Arc<Mutex<World>>;

/// A motor whose goals are `NUMBER MILLISECONDS`, and whose results are the numbers.
struct Motor {
    name: &'static str,
    loss: Loss,
    world: Shared,
    goal: String,
    ends: Instant,
    aborted: bool,
}

impl Motor {
    fn new(name: &'static str, loss: Loss, world: &Shared) -> Self {
        Self {
            name,
            loss,
            world: Arc::clone(world),
            goal: String::new(),
            ends: Instant::ZERO,
            aborted: false,
        }
    }

    fn deed(&self, change: impl FnOnce(&mut Deed)) {
        let mut world = self.world.lock().unwrap();
        change(world.deeds.entry(self.goal.clone()).or_default());
    }
}

fn parts(goal: &str) -> Option<(&str, u64)> {
    let (number, millis) = goal.split_once(' ')?;
    Some((number, millis.parse().ok()?))
}

impl Component for Motor {
    fn offer(&self) -> Offer<'_> {
        Offer::new(self.name).with_unit("ms").with_loss(self.loss)
    }

    fn check(&self, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        parts(goal).map(drop).ok_or(Refused)
    }

    fn start(&mut self, now: Instant, goal: &str, _why: &mut Report<'_>) -> Result<(), Refused> {
        let (_, millis) = parts(goal).ok_or(Refused)?;
        goal.clone_into(&mut self.goal);
        self.ends = now + Duration::from_millis(millis);
        self.aborted = false;
        self.deed(|deed| deed.begun += 1);
        Ok(())
    }

    fn poll(&mut self, now: Instant, report: &mut Report<'_>) -> Run {
        report.text(parts(&self.goal).map_or("", |(number, _)| number));
        if self.aborted {
            return Run::Aborted;
        }
        if now < self.ends {
            return Run::Running;
        }
        self.deed(|deed| deed.finished += 1);
        Run::Completed
    }

    fn abort(&mut self, _now: Instant) {
        self.aborted = true;
    }

    fn make_safe(&mut self, _now: Instant) {
        self.aborted = true;
    }
}

/// A device with an `arm`, which stops without a link, and a `belt`, which carries on.
pub(crate) struct Device {
    pub(crate) port: u16,
    world: Shared,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    pub(crate) fn power_on(link_timeout: Duration) -> Self {
        Self::seated(link_timeout, None)
    }

    /// A node of a shared line with this id.
    pub(crate) fn on_bus(link_timeout: Duration, id: u64) -> Self {
        Self::seated(link_timeout, Some(id))
    }

    fn seated(link_timeout: Duration, id: Option<u64>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        listener.set_nonblocking(true).unwrap();
        let world = Shared::default();
        let its = Arc::clone(&world);
        let thread = std::thread::spawn(move || {
            let mut boot = 81500 + 1000 * id.map_or(0, |id| id as u32);
            while !its.lock().unwrap().power_off {
                boot += 1;
                let mut identity = Identity::new("motors", "1", boot);
                identity.link_timeout = link_timeout;
                let motors = [
                    Motor::new("arm", Loss::Abort, &its),
                    Motor::new("belt", Loss::CarryOn, &its),
                ];
                match id {
                    None => run(&listener, &its, Node::<_, 4, 256>::new(identity, motors)),
                    Some(id) => {
                        let seat = OnBus::new(motors, id, ADDRESS);
                        run(&listener, &its, Node::<_, 4, 256>::new(identity, seat));
                    }
                }
            }
        });
        Self {
            port,
            world,
            thread: Some(thread),
        }
    }

    pub(crate) fn world(&self) -> MutexGuard<'_, World> {
        self.world.lock().unwrap()
    }

    /// What was done for a goal.
    pub(crate) fn deed(&self, goal: &str) -> Deed {
        self.world().deeds.get(goal).copied().unwrap_or_default()
    }

    /// For `ztl gateway --device`.
    pub(crate) fn url(&self) -> String {
        format!("motors=tcp:127.0.0.1:{}", self.port)
    }
}

impl Drop for Device {
    fn drop(&mut self) {
        if let Ok(mut world) = self.world.lock() {
            world.power_off = true;
        }
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// From one reset to the next.
fn run<C: Components>(listener: &TcpListener, world: &Shared, mut node: Node<'_, C, 4, 256>) {
    let start = std::time::Instant::now();
    let now = || Instant::from_micros(start.elapsed().as_micros() as u64);
    let mut line: Option<TcpStream> = None;
    let mut buffer = [0xA5; 256];
    loop {
        {
            let mut world = world.lock().unwrap();
            if world.unplugged {
                line = None;
            }
            world.connected = line.is_some();
            if world.power_off || std::mem::take(&mut world.reset) {
                return;
            }
        }
        if let Ok((stream, _)) = listener.accept()
            && !world.lock().unwrap().unplugged
        {
            stream.set_nonblocking(false).unwrap();
            // Paces the loop.
            let pace = Some(Duration::from_millis(1));
            stream.set_read_timeout(pace).unwrap();
            line = Some(stream);
        }
        let read = line.as_mut().map(|line| line.read(&mut buffer));
        // The time at which the bytes arrived, not at which the wait began.
        let (mute, deaf) = {
            let world = world.lock().unwrap();
            (world.mute, world.deaf)
        };
        match read {
            Some(Ok(0)) => line = None,
            Some(Ok(count)) if !deaf => {
                let frames = buffer[..count].windows(3);
                let to_all = frames.filter(|begin| begin[0] == 0 && begin[2] == ADDR_ALL);
                world.lock().unwrap().searched += to_all.count();
                node.handle_bytes(now(), &buffer[..count]);
            }
            Some(Err(error)) if !matches!(error.kind(), ErrorKind::WouldBlock) => line = None,
            Some(_) => {}
            None => std::thread::sleep(Duration::from_millis(1)),
        }
        node.handle_timeout(now());
        loop {
            let count = node.poll_transmit(now(), &mut buffer);
            if count == 0 {
                break;
            }
            if let Some(line) = line.as_mut().filter(|_| !mute) {
                let _ = line.write_all(&buffer[..count]);
            }
        }
    }
}
