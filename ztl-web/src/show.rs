//! The show: scenes of a script, played by the engine of `ztl run-script` on a thread of its own. Clients press, the thread
//! decides; it also enforces what happens when nobody operates any more.

mod connection;
pub(crate) mod handle;
mod stage;

use std::collections::{BTreeMap, HashSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::{Duration, Instant, SystemTime};

use serde_json::json;
use ztl_script::event::{DecidedBy, RunCommand, RunEvent, RunStarted, StampedEvent, TaskNumber};
use ztl_script::{Connect, OperatorGone, PlayOptions, Runner, Script, SeenStops};

use crate::aborts::AbortRequest;
use crate::board::Board;
use crate::clock::now_ms;
use crate::cut;
use crate::task::Task;
use handle::{Press, ShowHandle, Told, Wish};
use stage::Stage;

/// How often the thread looks whether somebody operates.
const TICK: Duration = Duration::from_millis(250);
/// Events that are taken before presses are looked for again.
const EVENTS: usize = 200;
/// Presses that wait for the thread.
const PRESSES: usize = 64;
/// Presses of a cue that follow each other within this time count as one.
const ONE_PRESS: Duration = Duration::from_millis(600);

/// A script, and how it is played.
pub struct Show {
    /// The script.
    pub script: Arc<Script>,
    /// How it is played.
    pub options: PlayOptions,
    /// Connects to its servers.
    pub connect: Connect,
    /// The first event of its record.
    pub started: RunStarted,
    /// What the operator should know before the first scene.
    pub notes: Vec<String>,
    /// Where its events are recorded.
    pub record: Option<Record>,
    /// The show aborts its tasks and ends when the other end of this is dropped.
    pub ending: Receiver<()>,
    /// Is dropped when it has ended.
    pub ended: SyncSender<()>,
}

/// The record of a show.
pub struct Record {
    /// Writes it.
    pub events: Box<dyn ShowRecord>,
    /// The file.
    pub file: PathBuf,
    /// Makes the report of the record as an HTML page, or says why that is impossible. The show goes on meanwhile.
    pub report: fn(&Path) -> Result<String, String>,
}

/// Records the events of a show.
pub trait ShowRecord: Send {
    /// Writes an event.
    ///
    /// # Errors
    /// What the operator should know; the show goes on.
    fn write(&mut self, event: &StampedEvent) -> Result<(), String>;

    /// What the operator should know since the last call.
    fn warnings(&self) -> Vec<String>;

    /// Ends it after the run.
    ///
    /// # Errors
    /// What it lacks.
    fn finish(self: Box<Self>) -> Result<(), String>;
}

/// Starts the thread of the show.
pub(crate) fn spawn(show: Show, board: &Arc<Board>) -> io::Result<()> {
    let Show {
        script,
        options,
        connect,
        started,
        notes,
        record,
        ending,
        ended,
    } = show;
    let connect = connection::watched(connect, board);
    let mut runner = Runner::new(Arc::clone(&script), options, connect);
    let (presses, pressed) = sync_channel(PRESSES);
    let handle = ShowHandle {
        runner: runner.handle(),
        presses,
    };
    let stage = Stage::new(record.is_some());
    board.set_show(handle);
    runner.tell(RunEvent::RunStarted(Box::new(started)));
    for text in notes {
        runner.tell(RunEvent::Note { text });
    }
    runner.begin();
    let mut thread = ShowThread {
        board: Arc::clone(board),
        script,
        runner,
        pressed,
        stage,
        record: record.map(|record| record.events),
        ending: Some(ending),
        began_ms: now_ms(),
        pressed_cues: BTreeMap::new(),
        given_up: HashSet::new(),
        scene_given_up: None,
    };
    let spawned = thread::Builder::new().name("ztl-web-show".to_owned());
    spawned
        .spawn(move || {
            thread.run();
            drop(ended);
        })
        .map(drop)
}

struct ShowThread {
    board: Arc<Board>,
    script: Arc<Script>,
    runner: Runner,
    pressed: Receiver<Press>,
    stage: Stage,
    record: Option<Box<dyn ShowRecord>>,
    /// `None` once the show ends.
    ending: Option<Receiver<()>>,
    /// When the show began, by the console's clock.
    began_ms: u64,
    /// When each cue was pressed last.
    pressed_cues: BTreeMap<usize, Instant>,
    /// Tasks of cues that were aborted because nobody operates.
    given_up: HashSet<TaskNumber>,
    /// The scene and take that were stopped for that reason.
    scene_given_up: Option<(usize, u32)>,
}

impl ShowThread {
    fn run(&mut self) {
        while !self.stage.has_ended() {
            while let Ok(press) = self.pressed.try_recv() {
                let is_late = now_ms() > press.not_after_ms;
                let told = match is_late && press.wish.starts() {
                    true => Err("too late, not done: press again".to_owned()),
                    false => self.on_press(press.wish, &press.by, press.seen),
                };
                // Fails if the client is gone.
                let _ = press.told.send(told);
            }
            for text in self.record.iter().flat_map(|record| record.warnings()) {
                self.runner.tell(RunEvent::Note { text });
            }
            if let Some(ending) = &self.ending
                && ending.try_recv() == Err(TryRecvError::Disconnected)
            {
                self.ending = None;
                let handle = self.runner.handle();
                handle.command(RunCommand::Stop, DecidedBy::Signal);
            }
            self.look_for_the_operator();
            let mut wait = TICK;
            for _ in 0..EVENTS {
                let Some(event) = self.runner.next(wait) else {
                    break;
                };
                wait = Duration::ZERO;
                self.on_event(&event);
            }
            self.board.publish_show(&self.stage.shown(&self.script));
        }
        if let Some(Err(lack)) = self.record.take().map(ShowRecord::finish) {
            tracing::error!("{lack}");
        }
    }

    fn on_event(&mut self, event: &StampedEvent) {
        if let Some(record) = &mut self.record
            && let Err(text) = record.write(event)
        {
            tracing::error!("{text}");
            let event = RunEvent::Note { text };
            let (at, wall) = (self.stage.at(), SystemTime::now());
            self.stage.handle(&StampedEvent { at, wall, event });
        }
        self.stage.handle(event);
    }

    fn on_press(&mut self, wish: Wish, by: &str, seen: SeenStops) -> Told {
        let may_start = self.runner.has_obeyed(seen);
        let stopped = || "everything was stopped as you pressed: nothing was done".to_owned();
        match wish {
            Wish::Note(text) => {
                let text = format!("{by}: {text}");
                self.runner.tell(RunEvent::Note { text });
                Ok(json!({}))
            }
            Wish::Command(RunCommand::StopScene, _) => {
                match self.runner.decide(RunCommand::StopScene, None) {
                    true => Ok(json!({})),
                    false => Err("no scene plays".to_owned()),
                }
            }
            _ if !may_start => Err(stopped()),
            Wish::Command(command, question) => {
                if question != self.stage.question_number() {
                    return Err("nothing was done: the show has gone on as you pressed".to_owned());
                }
                match self.runner.decide(command, self.stage.question()) {
                    true => Ok(json!({})),
                    false => Err("nothing was done: that is not possible now".to_owned()),
                }
            }
            Wish::Cue(cue) => {
                let last = self.pressed_cues.insert(cue, Instant::now());
                if last.is_some_and(|last| last.elapsed() < ONE_PRESS) {
                    return Err("pressed twice: counts as one press".to_owned());
                }
                if let Some(task) = self.runs_from_before(cue) {
                    return Err(format!(
                        "{task} still runs from before this console was started: abort it, or wait for its end"
                    ));
                }
                self.runner.cue(cue).map_err(str::to_owned)?;
                Ok(json!({}))
            }
        }
    }

    /// A task of a cue that still runs from before this show began: an earlier console may have started it.
    fn runs_from_before(&self, cue: usize) -> Option<String> {
        let tasks = &self.stage.cue(cue)?.tasks;
        tasks.iter().find_map(|task| {
            let (server, scope) = self.board.locate(&task.remote)?;
            let name = cut::text(&task.name(), cut::LINE);
            let seen = self.board.seen(server).tasks;
            let is_it = |seen: &Task| seen.runs && seen.scope == scope && seen.task == name;
            let is_earlier = |seen: &Task| seen.started_ms.is_some_and(|at| at < self.began_ms);
            seen.iter()
                .any(|seen| is_it(seen) && is_earlier(seen))
                .then_some(name)
        })
    }

    /// Stops what must not go on without an operator.
    fn look_for_the_operator(&mut self) {
        let alone = self.board.operator.alone_for();
        let is_due = |gone: OperatorGone| match gone {
            OperatorGone::GoOn => false,
            OperatorGone::Stop(after) => alone >= after,
        };
        if let Some(playing) = self.stage.playing()
            && self.scene_given_up != Some(playing)
            && let Some(scene) = self.script.scenes.get(playing.0)
            && is_due(scene.operator_gone)
        {
            self.scene_given_up = Some(playing);
            let name = scene.name.trim();
            let text = format!(
                "nobody operates for {} s: stopping scene '{name}'",
                alone.as_secs()
            );
            self.runner.tell(RunEvent::Note { text });
            let handle = self.runner.handle();
            handle.command(RunCommand::StopScene, DecidedBy::Script);
        }
        for (number, cue, id) in self.stage.cue_tasks() {
            let Some(plan) = self.script.cues.get(cue) else {
                continue;
            };
            if !is_due(plan.operator_gone) || !self.given_up.insert(number) {
                continue;
            }
            let name = plan.step.name.trim();
            let text = format!(
                "nobody operates for {} s: aborting cue '{name}'",
                alone.as_secs()
            );
            let place = self.board.locate(self.stage.remote_of(number));
            let asked = match place {
                Some((server, scope)) => {
                    let request = AbortRequest::of_stop((scope, id), None);
                    self.board.abort(server, request)
                }
                None => Err("its robot is not known".to_owned()),
            };
            let text = match asked {
                Ok(()) => text,
                Err(why) => format!("{text}: NOT SENT: {why}"),
            };
            self.runner.tell(RunEvent::Note { text });
        }
    }
}
