//! `ztl run-script`: plays the scenes of a script, with the original's options, lines and keys (wire
//! specification 7.4 and 8).

mod lines;
mod plain;
mod stage;

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use tracing::{Level, error, info};
use ztl_script::event::{By, Command, Event, FORMAT, Outcome, RemoteOutline, RunStarted, sha256};
use ztl_script::player::Options;
use ztl_script::record::Recorder;
use ztl_script::{Connect, Defaults, Player, Script, Show, StandIns, timeline};
use ztl_std::remotes::Remote;
use ztl_std::{RemoteTask, Remotes};
use ztl_yaml::{Span, closest};

use crate::called::Called;
use crate::exit::Done;
use crate::key_name::Pressed;
use crate::remotes_options::RemotesOptions;
use crate::terminal::{error_line, error_part, line};
use crate::{log, signals};
use lines::Lines;
use stage::Stage;

/// Name under which the original logs.
const LOG: &str = "script-exec";
/// How long the last lines of a run may take.
const LAST_LINES: Duration = Duration::from_secs(2);
/// When a second Ctrl-C ends the process however it stands: later than the run's own end.
const AT_THE_LATEST: Duration = Duration::from_secs(3);

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER)]
pub(crate) struct RunScript {
    /// The script
    #[arg(short, long, value_name = "FILE")]
    script: PathBuf,

    #[command(flatten)]
    endpoints: RemotesOptions,

    /// Play every scene without asking; what nobody can decide stops everything
    #[arg(long)]
    yes: bool,

    /// Only this scene
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,

    /// From this step on
    #[arg(long, value_name = "STEP")]
    from: Option<String>,

    /// What holds where the script says nothing: timeout, on_failure, parallel
    #[arg(long, value_name = "FILE")]
    defaults: Option<PathBuf>,

    /// Show what would be sent when, and send nothing
    #[arg(long)]
    dry_run: bool,

    /// Write down all that happens, a line for each event (docs/record.md); FILE must not be there yet
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,

    /// Write the original's lines, and take its keys, also on a terminal
    #[arg(long)]
    plain: bool,

    /// Rehearse: play on stand-ins for all servers, whose tasks last so many seconds
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, require_equals = true, default_missing_value = "1", value_parser = simulated)]
    simulate: Option<Duration>,
}

const AFTER: &str =
    "Keys: on a terminal those that can be pressed are always shown (docs/show.md). With --plain Enter plays
the scene that is shown, R the last one again, and any other passes over it.
Ctrl-C stops all tasks that this run has started, on all servers; a second one leaves at once.
Exit code: 0 if all went well, 1 if something failed, was stopped or is unknown.
How to write scripts: docs/scripts.md; to check one: ztl check FILE.";

fn simulated(text: &str) -> Result<Duration, &'static str> {
    let seconds = text
        .parse()
        .ok()
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    seconds.ok_or("write a number of seconds, as 1 or 0.2")
}

impl RunScript {
    pub(crate) fn run(self, called: &Called) -> Done {
        // By the original's name it is the original's tool.
        let live = !self.plain && !called.is_original() && stage::can_be_live();
        signals::catch()?;
        signals::leave_soon_after_the_second(AT_THE_LATEST, !live, stage::restore);
        // On the live view there is no place for lines; all that matters is shown there.
        let lines = (!live).then(Lines::start).transpose()?;
        if let Some(lines) = lines.clone() {
            // Where stand-ins are is of no use.
            let quiet: &[&str] = match self.simulate {
                Some(_) => &["remote-task", "remote-config"],
                None => &[],
            };
            log::init_to(Level::INFO, quiet, lines);
        }
        let done = self.play(called, lines.as_ref());
        if let Some(lines) = lines {
            lines.finish(LAST_LINES);
        }
        done
    }

    fn play(&self, called: &Called, lines: Option<&Lines>) -> Done {
        let live = lines.is_none();
        let mut remotes = match self.simulate {
            Some(_) if !self.endpoints.is_given() => Remotes::named("no configuration"),
            _ => self.endpoints.read()?,
        };
        let defaults = match &self.defaults {
            Some(path) => Defaults::load(path)
                .map_err(|mistakes| format!("mistakes in the defaults:\n{mistakes}"))?,
            None => Defaults::default(),
        };
        let script = match Script::load(&self.script, defaults) {
            Ok(script) => Arc::new(script),
            Err(mistakes) => {
                error_part(mistakes);
                let file = self.script.display();
                return Err(format!(
                    "{file} cannot be played; `ztl check {file}` says all that is wrong"
                )
                .into());
            }
        };
        // On the live view lines before it are not seen.
        let mut notes = Vec::new();
        if self.simulate.is_none() {
            for unknown in script.unknown_remotes(&remotes) {
                error_part(format_args!("{called}: warning: {unknown}"));
                notes.extend(unknown.to_string().lines().next().map(str::to_owned));
            }
        }
        if !script.doubts().is_empty() {
            let (count, file) = (script.doubts().len(), self.script.display());
            let (s, them) = if count == 1 {
                ("", "it")
            } else {
                ("s", "them")
            };
            let note =
                format!("{count} doubtful place{s} in {file}; `ztl check {file}` shows {them}");
            error_line(format_args!("{called}: warning: {note}"));
            notes.push(note);
        }
        let (scene, from) = self.places(&script)?;
        let mut options = Options {
            unattended: self.yes,
            scene,
            from,
            watch: live,
            ..Options::default()
        };
        if self.dry_run {
            for text in timeline(&script, &options, &remotes) {
                line(text);
            }
            return Ok(ExitCode::SUCCESS);
        }
        let stand_ins = self
            .simulate
            .map(|time| StandIns::start(&script, &mut remotes, time))
            .transpose()?;
        let known = script
            .remotes()
            .into_iter()
            .filter(|name| remotes.task(name).is_ok());
        options.remotes = known.map(str::to_owned).collect();
        let started = self.started(&script, &remotes);
        let player = Player::new(Arc::clone(&script), options);
        let mut show = Show::new(player, connect(remotes));
        if !live {
            notes.clear();
        }
        let outcome = self.perform(&mut show, &script, (started, notes), lines)?;
        drop(stand_ins);
        let code = ExitCode::from(u8::from(outcome != Outcome::Completed));
        Ok(signals::exit_code_or(code))
    }

    /// Plays it, on the live view or with the original's lines and keys.
    fn perform(
        &self,
        show: &mut Show,
        script: &Script,
        (started, notes): (RunStarted, Vec<String>),
        lines: Option<&Lines>,
    ) -> Result<Outcome, Box<dyn std::error::Error>> {
        let mut stage = Stage::open(script, show.inputs(), lines.cloned(), self.yes)?;
        let mut record = self.record.as_deref().map(Recorder::create).transpose()?;
        let inputs = show.inputs();
        signals::then(move || inputs.command(Command::Stop, By::Signal));
        show.tell(Event::RunStarted(Box::new(started)));
        for text in notes {
            show.tell(Event::Note { text });
        }
        show.begin();
        loop {
            while let Some(pressed) = stage.pressed() {
                let Pressed {
                    key,
                    command,
                    question,
                } = pressed;
                show.tell(Event::Key { key, command });
                if let Some(command) = command {
                    show.decide(command, question);
                }
            }
            let Some(stamped) = show.next(Duration::from_secs(3600)) else {
                continue;
            };
            if let Some(record) = &mut record
                && let Err(unrecorded) = record.write(&stamped)
            {
                stage.warn(stamped.at, &unrecorded.to_string());
            }
            stage.tell(&stamped);
            if let Event::RunEnded { outcome, .. } = stamped.event {
                stage.close();
                return Ok(outcome);
            }
        }
    }

    /// The scene to play alone, and the step to begin with.
    #[expect(clippy::type_complexity, reason = "as the player wants them")]
    fn places(&self, script: &Script) -> Result<(Option<usize>, Option<(usize, usize)>), String> {
        let scene = match &self.scene {
            None => None,
            Some(name) => {
                let scenes = script.scenes.iter().enumerate();
                let names = scenes.map(|(at, scene)| (at, (&scene.key, &scene.name, scene.span)));
                Some(the_one("scene", name, names)?)
            }
        };
        let from = match &self.from {
            None => None,
            Some(name) => {
                let scenes = script.scenes.iter().enumerate();
                let scenes = scenes.filter(|(at, _)| scene.is_none_or(|scene| scene == *at));
                let names = scenes.flat_map(|(scene, of)| {
                    let steps = of.steps.iter().enumerate();
                    steps.map(move |(at, step)| ((scene, at), (&step.key, &step.name, step.span)))
                });
                Some(the_one("step", name, names)?)
            }
        };
        Ok((scene, from))
    }

    /// What is known when the run starts.
    fn started(&self, script: &Script, remotes: &Remotes) -> RunStarted {
        let outline = |name: &str| {
            let remote = remotes.task(name).ok();
            RemoteOutline {
                name: name.to_owned(),
                endpoint: remote.map(Remote::endpoint),
                scope: remote
                    .map(|remote| remote.scope.clone())
                    .unwrap_or_default(),
            }
        };
        let mut options = Vec::new();
        let named = [
            ("--scene", self.scene.as_ref()),
            ("--from", self.from.as_ref()),
        ];
        for (option, value) in named
            .into_iter()
            .filter_map(|(option, value)| Some((option, value?)))
        {
            options.extend([option.to_owned(), value.clone()]);
        }
        let flags = [("--yes", self.yes), ("--simulate", self.simulate.is_some())];
        options.extend(
            flags
                .into_iter()
                .filter(|(_, on)| *on)
                .map(|(flag, _)| flag.to_owned()),
        );
        if let Some(path) = &self.defaults {
            options.extend(["--defaults".to_owned(), path.display().to_string()]);
        }
        let path = self.endpoints.path();
        RunStarted {
            format: FORMAT,
            script: self.script.display().to_string(),
            sha256: sha256(&script.document().bytes()),
            config: path.exists().then(|| path.display().to_string()),
            options,
            versions: versions(),
            remotes: script.remotes().into_iter().map(outline).collect(),
            outline: script.outline(),
        }
    }
}

/// The scene or step that a person means: by its key, or by its name without parameters.
fn the_one<'a, At>(
    what: &str,
    said: &str,
    all: impl Iterator<Item = (At, (&'a String, &'a String, Span))>,
) -> Result<At, String> {
    let mut names = Vec::new();
    let (mut found, mut lines) = (None, Vec::new());
    for (at, (key, name, span)) in all {
        let name = name.trim();
        names.push(name);
        if said == key || said.trim() == name {
            lines.push(span.start.line.to_string());
            found.get_or_insert(at);
        }
    }
    if lines.len() > 1 {
        let help = match what {
            "step" => "give --scene too, or different names",
            _ => "give them different names",
        };
        let lines = lines.join(", ");
        return Err(format!(
            "{what} '{said}' is ambiguous: it is in lines {lines}; {help}"
        ));
    }
    found.ok_or_else(|| {
        let help = match closest(said, names.iter().copied()) {
            Some(meant) => format!("did you mean '{meant}'?"),
            None => format!("there are: {}", names.join(", ")),
        };
        format!("no {what} '{said}'; {help}")
    })
}

fn no_keyboard(error: std::io::Error) -> String {
    // As the original says it, for scripts that look for it.
    let (code, text) = (
        error.raw_os_error().unwrap_or_default(),
        "Inappropriate ioctl for device",
    );
    error!(target: LOG, "({code}, '{text}')");
    "stdin is no terminal, so nobody can be asked; use --yes to play without asking".to_owned()
}

/// What may matter when a run is looked at long afterwards.
fn versions() -> Vec<(String, String)> {
    use std::env::consts::{ARCH, OS};
    let (major, minor, patch) = zmq::version();
    let version = |name: &str, version: String| (name.to_owned(), version);
    vec![
        version("ztl", env!("CARGO_PKG_VERSION").to_owned()),
        version("libzmq", format!("{major}.{minor}.{patch}")),
        version("system", format!("{OS} {ARCH}")),
    ]
}

/// Connects to servers when they are first used.
fn connect(remotes: Remotes) -> Connect {
    Box::new(move |name| {
        let remote = remotes.task(name).map_err(|error| error.to_string())?;
        info!(target: "remote-config", "Initialising remote task interface '{name}'...");
        RemoteTask::connect(&remote.endpoint(), &remote.scope).map_err(|error| error.to_string())
    })
}
