//! `ztl run-script`: plays the scenes of a script, with the options, output and keys of the original
//! (`docs/compatibility.md`, "Scripts", lists the differences).

mod output;
mod plain;
mod run_record;
mod simulated_servers;
mod view;

use std::collections::BTreeSet;
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use tracing::Level;
use ztl_script::event::{
    DecidedBy, FORMAT, RemoteOutline, RunCommand, RunEvent, RunOutcome, RunStarted,
};
use ztl_script::{Defaults, PlayOptions, Runner, Script, timeline};
use ztl_std::Remotes;
use ztl_std::remotes::Remote;
use ztl_yaml::{Span, closest};

use crate::called::Called;
use crate::connect_options::ConnectOptions;
use crate::exit::{Done, Misuse};
use crate::key_press::KeyPress;
use crate::remotes_options::RemotesOptions;
use crate::server_connection::connect;
use crate::terminal::{error_line, error_part, line};
use crate::{log, signals};
use output::LineOutput;
pub(crate) use run_record::RunRecord;
use simulated_servers::SimulatedServers;
use view::View;

/// What logs subscriptions, which concern the recording alone.
const SUBSCRIBER: &str = "object-subscriber";
/// Time limit for writing the last lines.
const LAST_LINES: Duration = Duration::from_secs(2);
/// Time from a second Ctrl-C to the end of the process; longer than the run needs to end by itself.
const END_LIMIT: Duration = Duration::from_secs(3);

#[derive(Debug, clap::Args)]
#[command(after_help = AFTER)]
pub(crate) struct RunScript {
    /// The script
    #[arg(short, long, value_name = "FILE")]
    script: PathBuf,

    #[command(flatten)]
    endpoints: RemotesOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Play all scenes without asking; a step that needs a decision aborts the tasks of this run and ends it
    #[arg(long)]
    yes: bool,

    /// Play only this scene
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,

    /// Start with this step
    #[arg(long, value_name = "STEP")]
    from: Option<String>,

    /// Defaults for the script: timeout, on_failure, parallel
    #[arg(long, value_name = "FILE")]
    defaults: Option<PathBuf>,

    /// Show what would be sent and when, without sending it
    #[arg(long)]
    dry_run: bool,

    /// Record all events: a line for each, or with a FILE.mcap together with all publishers of the configuration file
    /// (docs/record.md); FILE must not exist
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,

    /// In a recording, the bytes of this topic are sound: 16-bit samples, so many a second (repeatable)
    #[cfg(feature = "record")]
    #[arg(long, value_name = "TOPIC=RATE[xCHANNELS]", value_parser = crate::record::sound, requires = "record")]
    sound: Vec<(String, ztl_record::SoundFormat)>,

    /// Use the original's output and keys on a terminal too
    #[arg(long)]
    plain: bool,

    /// Rehearse on simulated servers, whose tasks take this long
    #[arg(long, value_name = "SECONDS", num_args = 0..=1, require_equals = true, default_missing_value = "1", value_parser = simulated)]
    simulate: Option<Duration>,
}

const AFTER: &str =
    "Keys: on a terminal the screen lists them (docs/show.md). With --plain, Enter plays the scene, R repeats
the last one, and any other key skips the scene.
Ctrl-C aborts the tasks of this run on all servers, and ends it. A second Ctrl-C ends it without waiting for servers.
Exit code: 0 if all tasks that were started completed, also if the show is left before its end; 1 if one failed, was
stopped or is unknown.
To write scripts, see docs/scripts.md. To check one, run `ztl check FILE`.";

fn simulated(text: &str) -> Result<Duration, &'static str> {
    let seconds = text
        .parse()
        .ok()
        .and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    seconds.ok_or("expected a number of seconds, such as 1 or 0.2")
}

impl RunScript {
    pub(crate) fn run(self, called: &Called) -> Done {
        let live = !self.plain && !called.is_original() && view::can_be_live();
        signals::catch()?;
        signals::leave_soon_after_the_second(END_LIMIT, !live, view::restore);
        // The live view shows what matters; log lines would garble it.
        let lines = (!live).then(LineOutput::start).transpose()?;
        if let Some(lines) = lines.clone() {
            // The addresses of simulated servers do not matter.
            let quiet: &[&str] = match self.simulate {
                Some(_) => &["remote-task", "remote-config", SUBSCRIBER],
                None => &[SUBSCRIBER],
            };
            let quiet: Vec<_> = quiet.iter().map(|target| (*target, Level::WARN)).collect();
            log::init_to(Level::INFO, &quiet, lines);
        }
        let done = self.play(called, lines.as_ref());
        if let Some(lines) = lines {
            lines.finish(LAST_LINES);
        }
        done
    }

    fn play(&self, called: &Called, lines: Option<&LineOutput>) -> Done {
        let live = lines.is_none();
        let mut remotes = match self.simulate {
            Some(_) if !self.endpoints.is_given() => Remotes::named("no configuration"),
            _ => self.endpoints.read()?,
        };
        let script = load(&self.script, self.defaults.as_deref())?;
        // The live view hides lines printed before it, so it repeats them.
        let asked = self.simulate.is_none().then_some(&remotes);
        let mut notes = warnings(&called, &self.script, &script, asked);
        let (scene, from) = self.selection(&script).map_err(Misuse)?;
        self.connecting.check()?;
        let mut options = PlayOptions {
            unattended: self.yes,
            scene,
            from,
            watch: live,
            ..PlayOptions::default()
        };
        if self.dry_run {
            for text in timeline(&script, &options, &remotes) {
                line(text);
            }
            return Ok(ExitCode::SUCCESS);
        }
        let connecting = match self.simulate {
            Some(_) => ConnectOptions::default(),
            None => self.connecting.clone(),
        };
        let simulated = self
            .simulate
            .map(|time| SimulatedServers::start(&script, &mut remotes, time))
            .transpose()?;
        options.remotes = known_remotes(&script, &remotes);
        let started = self.started(&script, &remotes);
        let streams = match self.simulate {
            // A rehearsal has nothing to do with real robots.
            Some(_) => Remotes::named("no configuration"),
            None => remotes.clone(),
        };
        let mut show = Runner::new(Arc::clone(&script), options, connect(remotes, connecting));
        // Before anything is sent.
        let record = self.record.as_deref();
        #[cfg(feature = "record")]
        let sounds = self.sound.as_slice();
        #[cfg(not(feature = "record"))]
        let sounds = ();
        let record = record.map(|path| {
            let runner = show.handle();
            RunRecord::create(path, (&streams, sounds), move || runner.wake())
        });
        let record = record.transpose()?;
        if !live {
            notes.clear();
        }
        let outcome = self.perform(&mut show, &script, (started, notes), (lines, record))?;
        drop(simulated);
        let fine = matches!(outcome, RunOutcome::Completed | RunOutcome::Left);
        let code = ExitCode::from(u8::from(!fine));
        Ok(signals::exit_code_or(code))
    }

    /// Plays the script until the run ends.
    fn perform(
        &self,
        show: &mut Runner,
        script: &Script,
        (started, notes): (RunStarted, Vec<String>),
        (lines, mut record): (Option<&LineOutput>, Option<RunRecord>),
    ) -> Result<RunOutcome, Box<dyn std::error::Error>> {
        let mut view = View::open(script, show.handle(), lines.cloned(), self.yes)?;
        let handle = show.handle();
        signals::then(move || handle.command(RunCommand::Stop, DecidedBy::Signal));
        show.tell(RunEvent::RunStarted(Box::new(started)));
        for text in notes {
            show.tell(RunEvent::Note { text });
        }
        show.begin();
        loop {
            while let Some(pressed) = view.pressed() {
                let KeyPress {
                    key,
                    command,
                    cue,
                    question,
                } = pressed;
                show.tell(RunEvent::Key { key, command });
                if let Some(command) = command {
                    show.decide(command, question);
                }
                if let Some(cue) = cue
                    && let Err(why) = show.cue(cue)
                {
                    let name = script.cues.get(cue).map_or("", |cue| cue.step.name.trim());
                    let text = format!("cue '{name}' was not started: {why}");
                    show.tell(RunEvent::Note { text });
                }
            }
            for text in record.iter().flat_map(RunRecord::warnings) {
                show.tell(RunEvent::Note { text });
            }
            let Some(stamped) = show.next(Duration::from_secs(3600)) else {
                continue;
            };
            if let Some(record) = &mut record
                && let Err(warning) = record.write(&stamped)
            {
                view.warn(stamped.at, &warning);
            }
            view.handle(&stamped);
            if let RunEvent::RunEnded { outcome, .. } = stamped.event {
                view.close();
                if let Some(Err(lack)) = record.map(RunRecord::finish) {
                    error_line(format_args!("ztl: warning: {lack}"));
                }
                return Ok(outcome);
            }
        }
    }

    /// The only scene to play, and the first step.
    #[expect(clippy::type_complexity, reason = "matches `PlayOptions`")]
    fn selection(
        &self,
        script: &Script,
    ) -> Result<(Option<usize>, Option<(usize, usize)>), String> {
        let scene = match &self.scene {
            None => None,
            Some(name) => {
                let scenes = script.scenes.iter().enumerate();
                let names = scenes.map(|(at, scene)| (at, (&scene.key, &scene.name, scene.span)));
                Some(find_unique("scene", name, names)?)
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
                Some(find_unique("step", name, names)?)
            }
        };
        Ok((scene, from))
    }

    /// The first event of the record.
    fn started(&self, script: &Script, remotes: &Remotes) -> RunStarted {
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
        started((&self.script, script), (&self.endpoints, remotes), options)
    }
}

/// Reads a script that can be played, with these defaults.
pub(crate) fn load(
    path: &Path,
    defaults: Option<&Path>,
) -> Result<Arc<Script>, Box<dyn std::error::Error>> {
    let defaults = match defaults {
        Some(path) => Defaults::load(path)
            .map_err(|mistakes| Misuse(format!("mistakes in the defaults:\n{mistakes}")))?,
        None => Defaults::default(),
    };
    Script::load(path, defaults)
        .map(Arc::new)
        .map_err(|mistakes| {
            error_part(mistakes);
            let file = path.display();
            format!("{file} cannot be played; `ztl check {file}` lists all mistakes").into()
        })
}

/// Prints what is doubtful about a script, and about its servers if it is to be played on `remotes`; returns the same as
/// notes for the operator.
pub(crate) fn warnings(
    called: &dyn Display,
    path: &Path,
    script: &Script,
    remotes: Option<&Remotes>,
) -> Vec<String> {
    let mut notes = Vec::new();
    // Then that is printed already.
    let is_unread = remotes.is_some_and(|remotes| remotes.unread().is_some());
    for unknown in remotes
        .into_iter()
        .flat_map(|remotes| script.unknown_remotes(remotes))
    {
        if !is_unread {
            error_part(format_args!("{called}: warning: {unknown}"));
        }
        notes.extend(unknown.to_string().lines().next().map(str::to_owned));
    }
    if script.doubts() > 0 {
        let (count, file) = (script.doubts(), path.display());
        let (s, them) = if count == 1 {
            ("", "it")
        } else {
            ("s", "them")
        };
        let note = format!("{count} doubtful place{s} in {file}; `ztl check {file}` shows {them}");
        error_line(format_args!("{called}: warning: {note}"));
        notes.push(note);
    }
    notes
}

/// The servers of a script that `remotes` has.
pub(crate) fn known_remotes(script: &Script, remotes: &Remotes) -> BTreeSet<String> {
    let names = script.remotes().into_iter();
    let known = names.filter(|name| remotes.task(name).is_ok());
    known.map(str::to_owned).collect()
}

/// The first event of a record. `options`: what changes what is played, as words of a command line.
pub(crate) fn started(
    (path, script): (&Path, &Script),
    (endpoints, remotes): (&RemotesOptions, &Remotes),
    options: Vec<String>,
) -> RunStarted {
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
    let config = endpoints.path();
    RunStarted {
        format: FORMAT,
        script: path.display().to_string(),
        sha256: script.sha256(),
        config: config.exists().then(|| config.display().to_string()),
        options,
        versions: versions(),
        remotes: script.remotes().into_iter().map(outline).collect(),
        outline: script.outline(),
    }
}

/// Finds the scene or step that the user named, by its key or its name without parameters.
fn find_unique<'a, At>(
    kind: &str,
    name: &str,
    candidates: impl Iterator<Item = (At, (&'a String, &'a String, Span))>,
) -> Result<At, String> {
    let mut names = Vec::new();
    let (mut found, mut lines) = (None, Vec::new());
    for (at, (key, candidate, span)) in candidates {
        let candidate = candidate.trim();
        names.push(candidate);
        if name == key || name.trim() == candidate {
            lines.push(span.start.line.to_string());
            found.get_or_insert(at);
        }
    }
    if lines.len() > 1 {
        let help = match kind {
            "step" => "give --scene too, or different names",
            _ => "give them different names",
        };
        let lines = lines.join(", ");
        return Err(format!(
            "{kind} '{name}' is ambiguous: it is in lines {lines}; {help}"
        ));
    }
    found.ok_or_else(|| {
        let help = match closest(name, names.iter().copied()) {
            Some(meant) => format!("did you mean '{meant}'?"),
            None => format!("there are: {}", names.join(", ")),
        };
        format!("no {kind} '{name}'; {help}")
    })
}

/// Versions for the record.
fn versions() -> Vec<(String, String)> {
    use std::env::consts::{ARCH, OS};
    let version = |name: &str, version: String| (name.to_owned(), version);
    vec![
        version("ztl", env!("CARGO_PKG_VERSION").to_owned()),
        version("system", format!("{OS} {ARCH}")),
    ]
}
