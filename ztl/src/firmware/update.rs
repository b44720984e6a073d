//! `ztl firmware update`: updates a gateway's device over its link.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use ed25519_dalek::{Digest as _, Sha512};
use ztl_core::dispatcher::NOTHING_KNOWN;
use ztl_std::gateway::{
    LONGEST_IMAGE, LONGEST_PART, RunningFirmware, UPDATES, UpdateGoal, UpdateOptions,
    UpdateProblem, Updated,
};
use ztl_std::{RemoteTask, RequestError, State, Status};

use super::sign::{parse, read as read_file};
use crate::client::{AFTER_ABORT, insist};
use crate::exit::{Done, Misuse};
use crate::param::At;
use crate::server_query::read;
use crate::signals;
use crate::terminal::{error_line, flat, is_live, line, rewrite};

/// Longest wait for the answer to a part or a question.
const LIMIT: Duration = Duration::from_secs(60);
/// How long the command waits after Ctrl-C until the device has said what it runs. After SIGTERM, it is [`AFTER_ABORT`].
const AFTER_CTRL_C: Duration = Duration::from_secs(30);
/// The outcome of an abort that was not taken.
const MAY_GO_ON: &str = "the update may go on, ztl ps shows it";
/// The outcome of an abort that is not over.
const NOT_KNOWN: &str = "it is not known which firmware the device will run, ztl devices shows it";
/// Cells of the progress bar.
const CELLS: usize = 30;

#[derive(Debug, Args)]
#[command(
    after_help = "Exit codes: 0 the new firmware runs and is confirmed; 1 not updated; 2 the command line or FILE is wrong; refused by the device:
3 the signature is wrong, 4 the image is for another board, 5 it is older than what runs; 6 the device went back to the firmware before.
Ctrl-C and SIGTERM abort the update. The command waits until the device has said what it runs, after Ctrl-C for 30 s, after SIGTERM
for 5 s, and exits with 130 or 143, or with 0 if the new firmware was confirmed before. A second signal ends the command at once."
)]
pub(crate) struct Update {
    #[command(flatten)]
    at: At,

    /// A file of `ztl firmware sign`
    file: PathBuf,

    /// End the tasks that run; otherwise a device with tasks refuses the update
    #[arg(long)]
    now: bool,

    /// Let the image be older than what runs
    #[arg(long)]
    downgrade: bool,
}

impl Update {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        signals::leave_at_the_second();
        let path = self.file.display();
        let file = read_file(&self.file).map_err(Misuse::of)?;
        let parsed = parse(&self.file, &file).map_err(Misuse)?;
        if file.len() > LONGEST_IMAGE {
            let most = LONGEST_IMAGE;
            return Err(Misuse(format!("{path}: longer than {most} bytes")).into());
        }
        let target = parsed.manifest.version;
        let device = self.at.device.clone();
        let mut remote = self.at.connect()?;
        let ask = |remote: &mut RemoteTask, goal: &UpdateGoal| {
            let status = remote.run(&device, UPDATES, &goal.to_text(), Some(LIMIT));
            status.map_err(|error| {
                let text = error.to_string();
                match text.contains(&format!("no component '{UPDATES}'")) {
                    true => "the gateway is older than firmware updates".to_owned(),
                    false => text,
                }
            })
        };
        let told = ask(&mut remote, &UpdateGoal::Status)?;
        if told.state != State::Completed {
            return Err(format!("{device}: {}", flat(&told.text)).into());
        }
        let before: RunningFirmware = read(&told.text)?;
        let name = flat(&device);
        let trial = if before.confirmed { "" } else { ", on trial" };
        line(format_args!(
            "{name}: runs {}{trial}; the image is {target}",
            flat(&before.version)
        ));
        let image = identity(&file);
        for (number, bytes) in file.chunks(LONGEST_PART).enumerate() {
            if let Some(code) = signals::exit_code() {
                let version = flat(&before.version);
                error_line(format_args!(
                    "ztl: {name}: not updated: the image was not sent; the device runs {version}"
                ));
                return Ok(code);
            }
            let part = UpdateGoal::part(&image, number * LONGEST_PART, bytes);
            let taken = ask(&mut remote, &part)?;
            if taken.state != State::Completed {
                return Err(format!("{device}: {}", flat(&taken.text)).into());
            }
        }
        let options = UpdateOptions {
            file: image,
            length: file.len(),
            now: self.now,
            downgrade: self.downgrade,
        };
        let goal = UpdateGoal::Run(options).to_text();
        let last = name.to_string();
        signals::leave_at_the_second_after(move || {
            error_line(format_args!("ztl: {last}: {NOT_KNOWN}"));
        });
        let task = remote.trigger(&device, UPDATES, &goal)?;
        let mut shown = Progress::default();
        let mut show = |status: &Result<Status, RequestError>| {
            if let Ok(status) = status
                && !status.state.is_final()
            {
                shown.show(&device, &status.text);
            }
        };
        let wanted = || !signals::stopped();
        let waited = remote.wait_while(task.id.clone(), None, wanted, &mut show);
        let ended = match waited {
            Err(_) if signals::stopped() => {
                // The outcome says whether it was in time.
                let answer = insist(&mut remote, &task.id);
                let limit = match &answer {
                    Err(error) if !error.was_answered() => Duration::ZERO,
                    _ if signals::in_a_hurry() => AFTER_ABORT,
                    _ => AFTER_CTRL_C,
                };
                let waited = remote.wait_with(task.id, Some(limit), |status| {
                    show(status);
                    true
                });
                waited.map_err(|error| match answer {
                    Ok(_) => NOT_KNOWN.to_owned(),
                    Err(why) if why.was_answered() => format!("{MAY_GO_ON}: {error}"),
                    Err(why) => format!("{MAY_GO_ON}: {why}"),
                })
            }
            waited => waited.map_err(|error| error.to_string()),
        };
        shown.end();
        match (ended, signals::exit_code()) {
            (Ok(status), _) => finish(&device, &status),
            (Err(reason), Some(code)) => {
                error_line(format_args!("ztl: {name}: {}", flat(&reason)));
                Ok(code)
            }
            (Err(reason), None) => Err(reason.into()),
        }
    }
}

/// A text that only this file has.
fn identity(file: &[u8]) -> String {
    let digest = Sha512::digest(file);
    let bytes = digest.iter().take(16);
    bytes.map(|byte| format!("{byte:02x}")).collect()
}

/// Tells how it ended.
fn finish(device: &str, status: &Status) -> Done {
    let name = flat(device);
    if status.state == State::Completed {
        let updated: Updated = read(&status.text)?;
        let (before, after) = (flat(&updated.before), flat(&updated.after));
        line(format_args!("{name}: runs {after}, before {before}"));
        if let Some(signed) = &updated.signed {
            let signed = flat(signed);
            error_line(format_args!(
                "ztl: {name}: the image was signed as {signed}, but says that it is {after}; sign it with the version that it says"
            ));
        }
        return Ok(ExitCode::SUCCESS);
    }
    let (problem, text) = UpdateProblem::split(&status.text);
    error_line(format_args!("ztl: {name}: {}", flat(text)));
    if let Some(code) = signals::exit_code() {
        return Ok(code);
    }
    Ok(match problem {
        UpdateProblem::Signature => ExitCode::from(3),
        UpdateProblem::Board => ExitCode::from(4),
        UpdateProblem::Older => ExitCode::from(5),
        UpdateProblem::Reverted => ExitCode::from(6),
        _ => ExitCode::FAILURE,
    })
}

/// What was shown last.
#[derive(Default)]
struct Progress {
    text: String,
    tenth: Option<usize>,
    live: bool,
}

impl Progress {
    /// Shows the progress: on a terminal as a bar in one line, elsewhere as a line for each tenth.
    fn show(&mut self, device: &str, text: &str) {
        // A server answers so until there is progress.
        if text == self.text || text == NOTHING_KNOWN {
            return;
        }
        text.clone_into(&mut self.text);
        let share = share(text);
        let name = flat(device);
        let text = flat(text);
        if is_live() {
            self.live = true;
            let bar = share.map(|(sent, length)| {
                let full = CELLS * sent / length;
                format!(" [{}{}]", "#".repeat(full), ".".repeat(CELLS - full))
            });
            return rewrite(&format!("{name}:{} {text}", bar.unwrap_or_default()), "");
        }
        let tenth = share.map(|(sent, length)| 10 * sent / length);
        if tenth.is_none() || tenth != self.tenth {
            self.tenth = tenth;
            line(format_args!("{name}: {text}"));
        }
    }

    /// Ends the line of the bar.
    fn end(&self) {
        if self.live {
            line("");
        }
    }
}

/// The bytes sent and the length in `sent 100 of 3000 bytes`.
fn share(text: &str) -> Option<(usize, usize)> {
    let (sent, length) = text.strip_prefix("sent ")?.split_once(" of ")?;
    let length: usize = length.strip_suffix(" bytes")?.parse().ok()?;
    let sent: usize = sent.parse().ok()?;
    (length > 0).then_some((sent.min(length), length))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_is_read_from_the_progress() {
        assert_eq!(share("sent 100 of 3000 bytes"), Some((100, 3000)));
        assert_eq!(share("sent 9 of 3 bytes"), Some((3, 3)));
        for text in [
            "sent 1 of 0 bytes",
            "sent x of 3 bytes",
            "the device restarts",
        ] {
            assert_eq!(share(text), None);
        }
    }
}
