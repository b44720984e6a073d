//! One client's socket: reads its messages, and writes answers and what it subscribed to.

use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use axum::extract::ws::{Message, Utf8Bytes, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt as _, StreamExt as _};
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, oneshot};
use tokio::time::{interval, timeout};
use ztl_std::RemoteId;

use crate::aborts::AbortRequest;
use crate::board::Board;
use crate::clients::{Client, ID, Out};
use crate::clock::now_ms;
use crate::gate::Role;
use crate::goal::{Goal, LATEST_MS};
use crate::goals::{self, News, TOO_LATE};
use crate::operator;
use crate::rosbridge::{self, GoalArgs, Head, Incoming};
use crate::show::handle::Wish;
use crate::streams::Listener;
use crate::topics::Topic;

/// Answers that wait to be written.
const QUEUE: usize = 64;
/// How long a client may take to receive a message.
const WRITE: Duration = Duration::from_secs(10);
/// How long a client may be silent, although it is pinged.
const SILENCE: Duration = Duration::from_secs(60);
/// How often a client is pinged, and told the state of the robots even if nothing changed.
const BEAT: Duration = Duration::from_secs(2);
/// Most Stops, most single aborts, and most wishes to the show, of a socket whose answers it waits for.
const ANSWERS: usize = 64;
/// Messages and goals in a second, and how many at once.
const MESSAGES: (f64, f64) = (50.0, 100.0);
const GOAL_RATE: (f64, f64) = (10.0, 20.0);
/// Stops the scene of the show that plays.
const STOP_SCENE: &str = "/ztl/show/stop_scene";
/// A message counts once more for each so many bytes. Beyond the limit, a longer one stops nothing, and is not read: that
/// takes time, for which a Stop of somebody else would wait.
const SHORT: usize = 4 * 1024;
/// Longest id or name in a message.
const NAMES: usize = 2048;

/// Serves a socket until it closes.
pub(crate) async fn serve(socket: WebSocket, board: Arc<Board>, address: IpAddr, role: Role) {
    let (write, read) = socket.split();
    let (out, queue) = mpsc::channel(QUEUE);
    board.sockets.fetch_add(1, Ordering::Relaxed);
    let client = Arc::<Client>::default();
    client.attach(out.clone());
    let mut reader = Reader {
        board: Arc::clone(&board),
        who: board.operator.client(role, address),
        out,
        client,
        has_started: false,
        stops: Arc::new(Semaphore::new(ANSWERS)),
        aborts: Arc::new(Semaphore::new(ANSWERS)),
        wishes: Arc::new(Semaphore::new(ANSWERS)),
        aborts_when_gone: false,
        tells_that_it_lives: false,
        messages: Rate::new(MESSAGES),
        goal_rate: Rate::new(GOAL_RATE),
    };
    tokio::select! {
        () = reader.read(read) => {}
        () = written(write, queue, &board) => {}
    }
    board.sockets.fetch_sub(1, Ordering::Relaxed);
    reader.leave();
}

/// Writes until the client is gone.
async fn written(
    mut to: SplitSink<WebSocket, Message>,
    mut queue: mpsc::Receiver<Out>,
    board: &Board,
) {
    let mut robots = board.topics.subscribe(Topic::Robots);
    let mut tasks = board.topics.subscribe(Topic::Tasks);
    let mut stop = board.topics.subscribe(Topic::Stop);
    let mut show = board.topics.subscribe(Topic::Show);
    let (mut on_robots, mut on_tasks, mut on_stop, mut on_show) = (false, false, false, false);
    let mut listener = Listener::new(&board.streams);
    let mut beat = interval(BEAT);
    let told = |message: &Utf8Bytes| vec![Message::Text(message.clone())];
    loop {
        let messages = tokio::select! {
            biased;
            Ok(()) = stop.changed(), if on_stop => told(&stop.borrow_and_update()),
            out = queue.recv() => match out {
                None => return,
                Some(Out::Text(text)) => vec![Message::from(text)],
                Some(Out::Listen(wanted, on)) => listener.listen(wanted, on),
                Some(Out::Subscribe(topic, on)) => {
                    let (flag, topic_of) = match topic {
                        Topic::Robots => (&mut on_robots, &mut robots),
                        Topic::Tasks => (&mut on_tasks, &mut tasks),
                        Topic::Stop => (&mut on_stop, &mut stop),
                        Topic::Show => (&mut on_show, &mut show),
                    };
                    *flag = on;
                    let message = topic_of.borrow_and_update();
                    // Nobody has pressed Stop yet, or there is no show: there is nothing to tell.
                    match on && !message.is_empty() {
                        true => told(&message),
                        false => Vec::new(),
                    }
                }
            },
            Ok(()) = tasks.changed(), if on_tasks => told(&tasks.borrow_and_update()),
            Ok(()) = robots.changed(), if on_robots => told(&robots.borrow_and_update()),
            Ok(()) = show.changed(), if on_show => told(&show.borrow_and_update()),
            messages = listener.changed() => messages,
            _ = beat.tick() => {
                let mut messages = vec![Message::Ping(Vec::new().into())];
                if on_robots {
                    messages.extend(told(&robots.borrow_and_update()));
                }
                messages
            }
        };
        for message in messages {
            match timeout(WRITE, to.send(message)).await {
                Ok(Ok(())) => {}
                _ => return,
            }
        }
    }
}

/// Reads what a client wants.
struct Reader {
    board: Arc<Board>,
    who: operator::Client,
    out: mpsc::Sender<Out>,
    client: Arc<Client>,
    /// Whether a goal came over this socket.
    has_started: bool,
    /// Limit the answers that come later.
    stops: Arc<Semaphore>,
    aborts: Arc<Semaphore>,
    wishes: Arc<Semaphore>,
    /// Whether its goals are aborted when it is gone.
    aborts_when_gone: bool,
    /// Whether it calls `/ztl/alive`. Then only its messages count: a browser also answers pings for a page that hangs.
    tells_that_it_lives: bool,
    messages: Rate,
    goal_rate: Rate,
}

impl Reader {
    async fn read(&mut self, mut from: SplitStream<WebSocket>) {
        while let Ok(Some(Ok(message))) = timeout(SILENCE, from.next()).await {
            let is_pong = matches!(message, Message::Ping(_) | Message::Pong(_));
            if !(is_pong && self.tells_that_it_lives) {
                self.board.operator.hear(&self.who);
            }
            let answer = match &message {
                Message::Text(text) => self.on_message(text.as_str()),
                // Some clients send their text as bytes.
                Message::Binary(bytes) => match std::str::from_utf8(bytes) {
                    Ok(text) => self.on_message(text),
                    Err(_) => Some(Out::Text(rosbridge::error("expected JSON in UTF-8"))),
                },
                Message::Close(_) => return,
                Message::Ping(_) | Message::Pong(_) => None,
            };
            if let Some(answer) = answer
                && self.out.send(answer).await.is_err()
            {
                return;
            }
            // Others may have pressed Stop.
            tokio::task::yield_now().await;
        }
    }

    fn on_message(&mut self, text: &str) -> Option<Out> {
        let error = |text: &str| Some(Out::Text(rosbridge::error(text)));
        let is_allowed = self.messages.allows(1 + text.len() / SHORT);
        if !is_allowed && text.len() > SHORT {
            let head = serde_json::from_str::<Head>(text).ok();
            return self.refuse_too_many(head.and_then(Head::goal));
        }
        let message = match serde_json::from_str::<Incoming>(text) {
            Ok(message) => message,
            Err(wrong) => return error(&format!("cannot read the message: {wrong}")),
        };
        if message.longest_name() > NAMES {
            return error(&format!("an id or a name is longer than {NAMES} bytes"));
        }
        // What stops something is never limited.
        let stops = match &message {
            Incoming::CancelActionGoal { .. } => true,
            Incoming::CallService { service, .. } => {
                matches!(service.as_str(), "/ztl/stop" | "/ztl/abort" | STOP_SCENE)
            }
            _ => false,
        };
        if !is_allowed && !stops {
            return self.refuse_too_many(match message {
                Incoming::SendActionGoal { id, action, .. } => Some((id, action)),
                _ => None,
            });
        }
        match message {
            Incoming::SendActionGoal {
                id,
                action,
                args,
                feedback,
            } => {
                let started = self.start(&id, &action, args, feedback);
                let why = started.err()?;
                self.client.refuse(&id, &action, &why);
                Some(Out::Text(rosbridge::goal_refused(&id, &action, &why)))
            }
            Incoming::CancelActionGoal { id, action } => {
                let why = self.cancel(&id, &action).err()?;
                error(&why)
            }
            Incoming::CallService { id, service, args } => self.call(id, service, args),
            Incoming::Subscribe { topic } => Some(self.subscribe(&topic, true)),
            Incoming::Unsubscribe { topic } => Some(self.subscribe(&topic, false)),
        }
    }

    /// The answer to a message, which may be a goal, beyond the limit.
    fn refuse_too_many(&self, goal: Option<(String, String)>) -> Option<Out> {
        let why = "too many messages: send fewer";
        let goal = goal.filter(|(id, action)| id.len().max(action.len()) <= NAMES);
        let text = match goal {
            Some((id, action)) => {
                self.client.refuse(&id, &action, why);
                rosbridge::goal_refused(&id, &action, why)
            }
            None => rosbridge::error(why),
        };
        Some(Out::Text(text))
    }

    fn subscribe(&self, topic: &str, on: bool) -> Out {
        match (self.board.streams.find(topic), Topic::of(topic)) {
            (Some(wanted), _) => Out::Listen(wanted, on),
            (None, Ok(topic)) => Out::Subscribe(topic, on),
            (None, Err(why)) => Out::Text(rosbridge::error(&why)),
        }
    }

    fn start(
        &mut self,
        id: &str,
        action: &str,
        args: GoalArgs,
        feedback: bool,
    ) -> Result<(), String> {
        if id.len() > ID {
            return Err(format!("the id is longer than {ID} bytes"));
        }
        if !self.goal_rate.allows(1) {
            return Err("too many goals: send fewer".to_owned());
        }
        let now = now_ms();
        let not_after = args.not_after_ms.map_or(u64::MAX, |ms| ms as u64);
        if now > not_after {
            return Err(format!(
                "{TOO_LATE}: it arrived {} ms after its time",
                now - not_after
            ));
        }
        let not_after = not_after.min(now + LATEST_MS);
        let target = self.board.find(action)?;
        let by = self.who.by.clone();
        let goal = Arc::new(Goal::new(target, args.goal, by, not_after));
        self.client.begin(id, action, &goal)?;
        let operates = self.board.begins_to_operate(&self.who);
        operates.inspect_err(|_| self.client.forget(id))?;
        self.has_started = true;
        let (client, key, action) = (Arc::clone(&self.client), id.to_owned(), action.to_owned());
        let tell = move |news| match news {
            News::Progress(text) if feedback => client.progress(&key, &action, &text),
            News::Progress(_) => {}
            News::Ended(outcome) => client.end(&key, &outcome),
        };
        goals::start(&goal, &self.board, Box::new(tell)).inspect_err(|_| self.client.forget(id))
    }

    fn cancel(&self, id: &str, action: &str) -> Result<(), String> {
        let goal = self.client.goal(id);
        let goal = goal.ok_or_else(|| format!("no goal '{id}' of '{action}' is open"))?;
        goals::cancel(&goal, &self.board)
    }

    fn call(&mut self, id: Option<Value>, service: String, args: Value) -> Option<Out> {
        let told = match service.as_str() {
            "/ztl/robots" => self.newest(Topic::Robots),
            "/ztl/tasks" => self.newest(Topic::Tasks),
            "/ztl/show" => self.newest(Topic::Show),
            "/ztl/time" => Ok(json!({ "now_ms": now_ms() })),
            "/ztl/when_gone" => self.when_gone(&args),
            "/ztl/alive" => {
                self.tells_that_it_lives = true;
                Ok(json!({}))
            }
            "/ztl/describe" => self.board.describe(&args),
            "/ztl/past" => self.board.past.find(args),
            "/ztl/operate" => self.board.take_over(&self.who, &args),
            "/ztl/resume" => self.resume(&args),
            "/ztl/stop" => match self.stop(id.clone()) {
                Ok(()) => return None,
                Err(why) => Err(why),
            },
            "/ztl/show/command" => return self.wish(id, "/ztl/show/command", args, Wish::command),
            "/ztl/show/cue" => return self.wish(id, "/ztl/show/cue", args, Wish::cue),
            "/ztl/show/note" => return self.wish(id, "/ztl/show/note", args, Wish::note),
            STOP_SCENE => return self.wish(id, STOP_SCENE, args, |_| Ok(Wish::stop_scene())),
            "/ztl/abort" => match self.abort(id.clone(), args) {
                Ok(()) => return None,
                Err(why) => Err(why),
            },
            _ => Err(format!(
                "no service '{service}': there are /ztl/robots, /ztl/tasks, /ztl/describe, /ztl/past, /ztl/show, /ztl/show/command, /ztl/show/cue, /ztl/show/note, /ztl/show/stop_scene, /ztl/time, /ztl/abort, /ztl/stop, /ztl/operate, /ztl/alive, /ztl/when_gone and /ztl/resume"
            )),
        };
        Some(Out::Text(rosbridge::service_response(
            id.as_ref(),
            &service,
            told,
        )))
    }

    /// The value of a topic, and what this client may do.
    fn newest(&self, topic: Topic) -> Result<Value, String> {
        let mut value = self.board.topics.newest(topic)?;
        if let Some(members) = value.as_object_mut() {
            let operates = self.who.role == Role::Operator;
            members.insert("may_operate".to_owned(), json!(operates));
            members.insert("client".to_owned(), json!(self.who.number));
            members.insert("now_ms".to_owned(), json!(now_ms()));
        }
        Ok(value)
    }

    fn when_gone(&mut self, args: &Value) -> Result<Value, String> {
        let abort = args.get("abort").and_then(Value::as_bool);
        self.aborts_when_gone = abort.ok_or("expected {\"abort\": true} or {\"abort\": false}")?;
        Ok(json!({ "abort": self.aborts_when_gone }))
    }

    /// The client has a name, by which it finds its goals again.
    fn resume(&mut self, args: &Value) -> Result<Value, String> {
        let name = args.get("client").and_then(Value::as_str);
        let name = name.ok_or("expected {\"client\": a secret name}")?;
        if self.has_started {
            return Err("resume before the first goal of a socket".to_owned());
        }
        self.client = self.board.clients.named(name)?;
        Ok(self.client.attach(self.out.clone()))
    }

    /// Aborts everything. The answer follows when all is decided.
    fn stop(&self, id: Option<Value>) -> Result<(), String> {
        let press = self.board.press_stop(&self.who.by);
        let place = Arc::clone(&self.stops).try_acquire_owned();
        let place = place.map_err(|_| {
            format!("it was sent, but {ANSWERS} answers are awaited already: no answer will follow")
        })?;
        let board = Arc::clone(&self.board);
        let told = async move { Ok(board.stops.answer(press).await) };
        self.answer_later(id, "/ztl/stop", place, told);
        Ok(())
    }

    /// Aborts one task. The answer follows when it is known.
    fn abort(&self, id: Option<Value>, args: Value) -> Result<(), String> {
        #[derive(Deserialize)]
        struct Named {
            robot: String,
            scope: String,
            id: RemoteId,
        }
        let wrong = |error| format!("expected robot, scope and id of a task: {error}");
        let named: Named = serde_json::from_value(args).map_err(wrong)?;
        let mut servers = self.board.servers.iter();
        let server = servers.position(|server| server.name == named.robot);
        let server = server.ok_or_else(|| format!("no robot '{}'", named.robot))?;
        let place = Arc::clone(&self.aborts).try_acquire_owned();
        let place = place.map_err(|_| format!("not sent: {ANSWERS} aborts are under way"))?;
        let (told, telling) = oneshot::channel();
        let request = AbortRequest::told((named.scope, named.id), told);
        self.board.abort(server, request)?;
        let told = async {
            let told = telling.await;
            told.unwrap_or_else(|_| Err("it may still run".to_owned()))
        };
        self.answer_later(id, "/ztl/abort", place, told);
        Ok(())
    }

    /// Passes a wish to the show. The answer follows when the show has decided.
    fn wish(
        &mut self,
        id: Option<Value>,
        service: &'static str,
        args: Value,
        read: impl FnOnce(Value) -> Result<Wish, String>,
    ) -> Option<Out> {
        let not_after = args.get("not_after_ms").and_then(Value::as_f64);
        let not_after_ms = not_after.map_or(u64::MAX, |ms| ms as u64);
        let wish = read(args);
        let passed = wish.and_then(|wish| {
            let show = self.board.show();
            let show = show.ok_or("there is no show: start `ztl web` with --script")?;
            // Whoever may stop everything may stop a scene.
            if !wish.stops() {
                if !self.goal_rate.allows(1) {
                    return Err("too many commands: send fewer".to_owned());
                }
                self.board.begins_to_operate(&self.who)?;
            }
            let place = Arc::clone(&self.wishes).try_acquire_owned();
            let place = place.map_err(|_| format!("not done: {ANSWERS} answers are awaited"))?;
            Ok((
                show.press(wish, &self.who.by, not_after_ms, &self.board.stops)?,
                place,
            ))
        });
        match passed {
            Ok((telling, place)) => {
                let told = async {
                    let told = telling.await;
                    told.unwrap_or_else(|_| Err("the show has ended".to_owned()))
                };
                self.answer_later(id, service, place, told);
                None
            }
            Err(why) => {
                let answer = rosbridge::service_response(id.as_ref(), service, Err(why));
                Some(Out::Text(answer))
            }
        }
    }

    /// Answers a call when the answer is known. Neither a thread nor the client's other messages wait for it.
    fn answer_later(
        &self,
        id: Option<Value>,
        service: &'static str,
        place: OwnedSemaphorePermit,
        told: impl Future<Output = Result<Value, String>> + Send + 'static,
    ) {
        let out = self.out.clone();
        tokio::spawn(async move {
            tokio::select! {
                told = told => {
                    let answer = rosbridge::service_response(id.as_ref(), service, told);
                    // Fails if the client is gone.
                    let _ = out.send(Out::Text(answer)).await;
                }
                () = out.closed() => {}
            }
            drop(place);
        });
    }

    /// The client is gone: leaves or aborts what it started, as it has chosen.
    fn leave(&self) {
        self.board.client_left(&self.who);
        for goal in self.client.leave(&self.out) {
            if self.aborts_when_gone
                && let Err(error) = goals::cancel(&goal, &self.board)
            {
                tracing::error!("a goal of a client that is gone was not aborted: {error}");
            }
        }
    }
}

/// A limit on how often.
struct Rate {
    a_second: f64,
    at_once: f64,
    left: f64,
    at: Instant,
}

impl Rate {
    fn new((a_second, at_once): (f64, f64)) -> Self {
        Self {
            a_second,
            at_once,
            left: at_once,
            at: Instant::now(),
        }
    }

    /// Whether so much more is allowed now.
    fn allows(&mut self, count: usize) -> bool {
        let count = count as f64;
        let now = Instant::now();
        let earned = now.duration_since(self.at).as_secs_f64() * self.a_second;
        self.left = (self.left + earned).min(self.at_once);
        self.at = now;
        let allowed = self.left >= count;
        if allowed {
            self.left -= count;
        }
        allowed
    }
}
