//! A [`Session`] on a thread with its sockets.

mod sockets;

use std::fmt;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use mio::{Events, Poll, Token, Waker};

use crate::meta_object::MetaObject;
use crate::session::{
    Action, Call, CallError, CallId, Cancel, Event, Options, Session, SignalOf, SubscriptionId,
};
use crate::table::Table;
use crate::value::Value;

use sockets::{Found, Sockets};

const WAKER: Token = Token(usize::MAX);

/// The robot. Clones share the connections, which are closed when the last clone is dropped.
///
/// All callbacks run on one thread, and must not block.
#[derive(Clone)]
pub struct Client {
    shared: Arc<Shared>,
}

struct Shared {
    commands: Sender<ClientCommand>,
    waker: Arc<Waker>,
    /// Handles begin again after 4 billion.
    last: AtomicU32,
}

/// A call that was begun, to be cancelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct CallHandle(u32);

/// A subscription that was begun, to be ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct SubscriptionHandle(u32);

type Done<T> = Box<dyn FnOnce(Result<T, CallError>) + Send>;
type Each = Box<dyn FnMut(Event) + Send>;

enum ClientCommand {
    Call(CallHandle, Call, Duration, Done<Value>),
    Describe(String, Duration, Done<Arc<MetaObject>>),
    Services(Sender<Vec<String>>),
    Cancel(CallHandle, Box<dyn FnOnce(Cancel) + Send>),
    Subscribe(SubscriptionHandle, SignalOf, Each),
    Unsubscribe(SubscriptionHandle),
    Found(Found),
    Stop,
}

impl fmt::Debug for Client {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Client")
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        let _ = self.commands.send(ClientCommand::Stop);
        let _ = self.waker.wake();
    }
}

impl Client {
    /// Starts the thread, which connects and reconnects by itself. `on_event` gets what concerns the robot as a whole:
    /// [`Event::Connected`], [`Event::Disconnected`], [`Event::NewToken`], [`Event::ServiceAdded`] and
    /// [`Event::ServiceRemoved`].
    ///
    /// # Errors
    /// The system gives no thread or no file.
    pub fn start(
        options: Options,
        on_event: impl FnMut(Event) + Send + 'static,
    ) -> io::Result<Self> {
        let poll = Poll::new()?;
        let waker = Arc::new(Waker::new(poll.registry(), WAKER)?);
        let (commands, inbox) = channel();
        let shared = Arc::new(Shared {
            commands: commands.clone(),
            waker: Arc::clone(&waker),
            last: AtomicU32::new(0),
        });
        let mut worker = Worker {
            session: Session::new(options, Instant::now()),
            sockets: Sockets::default(),
            poll,
            inbox,
            own: (commands, waker),
            on_event: Box::new(on_event),
            calls: Table::default(),
            descriptions: Table::default(),
            subscriptions: Table::default(),
        };
        let thread = std::thread::Builder::new().name("ztl-naoqi".to_owned());
        thread.spawn(move || worker.run())?;
        Ok(Self { shared })
    }

    /// Calls a method. If that is not possible within `wait`, the call ends as [`CallError::NotSent`]. Once it is
    /// sent, there is no limit of time.
    pub fn call(
        &self,
        call: Call,
        wait: Duration,
        done: impl FnOnce(Result<Value, CallError>) + Send + 'static,
    ) -> CallHandle {
        let handle = CallHandle(self.new_handle());
        self.send(ClientCommand::Call(handle, call, wait, Box::new(done)));
        handle
    }

    /// Calls a method, and waits until it has ended. Do not call this from a callback.
    ///
    /// # Errors
    /// [`CallError`] says whether the call was sent.
    pub fn call_and_wait(&self, call: Call, wait: Duration) -> Result<Value, CallError> {
        let (sender, result) = channel();
        self.call(call, wait, move |result| drop(sender.send(result)));
        result.recv().unwrap_or_else(|_| Err(stopped()))
    }

    /// Asks for the description of a service, and waits for the answer. Do not call this from a callback.
    ///
    /// # Errors
    /// [`CallError`] if it cannot be asked within `wait`.
    pub fn describe(&self, service: &str, wait: Duration) -> Result<Arc<MetaObject>, CallError> {
        let (sender, result) = channel();
        self.describe_then(service, wait, move |result| drop(sender.send(result)));
        result.recv().unwrap_or_else(|_| Err(stopped()))
    }

    /// Asks what a service says of itself, and calls `done` with the answer, or with why there is none within `wait`.
    pub fn describe_then(
        &self,
        service: &str,
        wait: Duration,
        done: impl FnOnce(Result<Arc<MetaObject>, CallError>) + Send + 'static,
    ) {
        self.send(ClientCommand::Describe(
            service.to_owned(),
            wait,
            Box::new(done),
        ));
    }

    /// The services that the directory lists now. Do not call this from a callback.
    #[must_use]
    pub fn services(&self) -> Vec<String> {
        let (sender, services) = channel();
        self.send(ClientCommand::Services(sender));
        services.recv().unwrap_or_default()
    }

    /// Asks to cancel a call. `told` gets whether the service was asked.
    pub fn cancel(&self, call: CallHandle, told: impl FnOnce(Cancel) + Send + 'static) {
        self.send(ClientCommand::Cancel(call, Box::new(told)));
    }

    /// Subscribes to a signal until [`unsubscribe`](Self::unsubscribe). `each` gets [`Event::Signal`],
    /// [`Event::Subscribed`] and [`Event::Unsubscribed`].
    pub fn subscribe(
        &self,
        signal: SignalOf,
        each: impl FnMut(Event) + Send + 'static,
    ) -> SubscriptionHandle {
        let handle = SubscriptionHandle(self.new_handle());
        self.send(ClientCommand::Subscribe(handle, signal, Box::new(each)));
        handle
    }

    /// Ends a subscription.
    pub fn unsubscribe(&self, subscription: SubscriptionHandle) {
        self.send(ClientCommand::Unsubscribe(subscription));
    }

    fn new_handle(&self) -> u32 {
        self.shared.last.fetch_add(1, Ordering::Relaxed)
    }

    /// A thread that has ended drops the command, and with it what waits for its answer.
    fn send(&self, command: ClientCommand) {
        let _ = self.shared.commands.send(command);
        let _ = self.shared.waker.wake();
    }
}

fn stopped() -> CallError {
    CallError::Unknown("the client has stopped".to_owned())
}

struct Worker {
    session: Session,
    sockets: Sockets,
    poll: Poll,
    inbox: Receiver<ClientCommand>,
    /// For threads that look up names.
    own: (Sender<ClientCommand>, Arc<Waker>),
    on_event: Each,
    calls: Table<CallId, (CallHandle, Done<Value>)>,
    descriptions: Table<CallId, Done<Arc<MetaObject>>>,
    subscriptions: Table<SubscriptionId, (SubscriptionHandle, Each)>,
}

impl Worker {
    fn run(&mut self) {
        let mut ready = Events::with_capacity(64);
        while self.take_commands() {
            self.work();
            let left = match self.sockets.is_readable() {
                true => Some(Duration::ZERO),
                false => self
                    .session
                    .poll_timeout()
                    .map(|at| at.saturating_duration_since(Instant::now())),
            };
            match self.poll.poll(&mut ready, left) {
                Ok(()) => {}
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                // Without it, nothing can be waited for.
                Err(_) => return,
            }
            for event in &ready {
                self.sockets.mark(event);
            }
            let now = Instant::now();
            self.sockets
                .connect_further(&self.poll, &mut self.session, now);
            self.sockets.read(&mut self.session, now);
            self.session.handle_timeout(now);
        }
    }

    /// False once the client is gone.
    fn take_commands(&mut self) -> bool {
        while let Ok(command) = self.inbox.try_recv() {
            let now = Instant::now();
            match command {
                ClientCommand::Call(handle, call, wait, done) => {
                    match self.session.call(call, wait, now) {
                        Ok(call) => {
                            self.calls.insert(call, (handle, done));
                        }
                        Err(error) => done(Err(error)),
                    }
                }
                ClientCommand::Describe(service, wait, done) => {
                    match self.session.describe(&service, wait, now) {
                        Ok(call) => drop(self.descriptions.insert(call, done)),
                        Err(error) => done(Err(error)),
                    }
                }
                ClientCommand::Services(sender) => {
                    let services = self.session.services().map(str::to_owned).collect();
                    let _ = sender.send(services);
                }
                ClientCommand::Cancel(handle, told) => {
                    let mut calls = self.calls.iter();
                    let call = calls.find(|(_, (other, _))| *other == handle);
                    told(call.map_or(Cancel::Ended, |(call, _)| self.session.cancel(*call)));
                }
                ClientCommand::Subscribe(handle, signal, each) => {
                    let id = self.session.subscribe(signal);
                    self.subscriptions.insert(id, (handle, each));
                }
                ClientCommand::Unsubscribe(handle) => {
                    let subscriptions = self.subscriptions.iter();
                    let found = subscriptions
                        .filter(|(_, (other, _))| *other == handle)
                        .map(|(id, _)| *id)
                        .next();
                    if let Some(id) = found {
                        self.session.unsubscribe(id);
                        self.subscriptions.remove(&id);
                    }
                }
                ClientCommand::Found(found) => {
                    self.sockets
                        .found(found, &self.poll, &mut self.session, now);
                }
                ClientCommand::Stop => return false,
            }
        }
        true
    }

    /// Does what the session has decided.
    fn work(&mut self) {
        loop {
            let mut idle = true;
            while let Some(action) = self.session.poll_action() {
                idle = false;
                let now = Instant::now();
                match action {
                    Action::Connect(link, endpoint) => {
                        if let Some(found) = sockets::look_up(link, &endpoint, &self.own) {
                            self.sockets
                                .found(found, &self.poll, &mut self.session, now);
                        }
                    }
                    Action::Close(link) => self.sockets.close(link),
                }
            }
            while let Some(event) = self.session.poll_event() {
                idle = false;
                self.pass_on(event);
            }
            if idle {
                return self.sockets.write(&mut self.session);
            }
        }
    }

    fn pass_on(&mut self, event: Event) {
        match event {
            Event::Ended { call, result } => {
                if let Some((_, done)) = self.calls.remove(&call) {
                    done(result);
                }
            }
            Event::Described { call, result } => {
                if let Some(done) = self.descriptions.remove(&call) {
                    done(result);
                }
            }
            Event::Subscribed(subscription)
            | Event::Unsubscribed { subscription, .. }
            | Event::Signal { subscription, .. } => {
                if let Some((_, each)) = self.subscriptions.get_mut(&subscription) {
                    each(event);
                }
            }
            _ => (self.on_event)(event),
        }
    }
}
