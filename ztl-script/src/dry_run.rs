//! What would be sent when: `--dry-run`.

use std::time::Duration;

use ztl_std::remotes::Remotes;

use crate::model::{OnFailure, Step};
use crate::player::PlayOptions;
use crate::script::Script;

/// The timeline of a script as lines for people: each task with its time since the start of its step, and
/// what the step then waits for, whose duration is unknown.
#[must_use]
pub fn timeline(script: &Script, options: &PlayOptions, remotes: &Remotes) -> Vec<String> {
    let mut lines = Vec::new();
    let first = options
        .scene
        .or(options.from.map(|(scene, _)| scene))
        .unwrap_or(0);
    let last = options.scene.unwrap_or(usize::MAX);
    for (index, scene) in script.scenes.iter().enumerate() {
        if index < first || index > last {
            continue;
        }
        let delay = after(scene.delay);
        lines.push(format!("scene '{}'{delay}", scene.name.trim()));
        let from = match options.from {
            Some((of, step)) if of == index => step,
            _ => 0,
        };
        for step in scene.steps.iter().skip(from) {
            put_step(step, remotes, &mut lines);
        }
    }
    for cue in &script.cues {
        let key = cue
            .key
            .map_or_else(String::new, |key| format!(", key {key}"));
        lines.push(format!("cue '{}'{key}", cue.step.name.trim()));
        for task in &cue.step.tasks {
            if let Some(handler) = cue.step.handler(task) {
                let (name, component, goal) = (&handler.name, &task.component, &task.goal);
                let to = target(&handler.remote, remotes);
                lines.push(format!("    {name}:{component}:{goal}  -> {to}"));
            }
        }
    }
    lines
}

fn target(name: &str, remotes: &Remotes) -> String {
    match remotes.task(name) {
        Ok(remote) => format!("{} {}", remote.endpoint(), remote.scope),
        Err(_) => format!("no server '{name}'"),
    }
}

fn put_step(step: &Step, remotes: &Remotes, lines: &mut Vec<String>) {
    let together = if step.parallel {
        ", its tasks together"
    } else {
        ""
    };
    let policy = match step.on_failure {
        OnFailure::Usual => String::new(),
        OnFailure::GoOn => ", on failure: go on".to_owned(),
        OnFailure::Ask => ", on failure: ask".to_owned(),
        OnFailure::Stop => ", on failure: stop".to_owned(),
        OnFailure::Retry(count) => format!(", on failure: retry {count}"),
    };
    lines.push(format!("  step '{}'{together}{policy}", step.name.trim()));
    let mut at = step.delay;
    let mut waits = Vec::new();
    for task in &step.tasks {
        let Some(handler) = step.handler(task) else {
            continue;
        };
        // A task without a server is not waited for.
        let known = remotes.task(&handler.remote).is_ok();
        let begins = match (step.parallel, known) {
            (true, _) => step.delay + task.delay,
            (false, true) => {
                at += task.delay;
                at
            }
            (false, false) => at,
        };
        let to = target(&handler.remote, remotes);
        let (name, component, goal) = (&handler.name, &task.component, &task.goal);
        lines.push(format!(
            "    +{:>6.2} s  {name}:{component}:{goal}  -> {to}",
            begins.as_secs_f64()
        ));
        if step.wait && task.wait && known {
            let limit = task
                .limit
                .map(|limit| format!(" (at most {} s)", limit.as_secs_f64()));
            waits.push(format!("{}{}", component.trim(), limit.unwrap_or_default()));
        }
    }
    lines.push(match waits.is_empty() {
        true => "    then goes on at once".to_owned(),
        false => format!("    then waits for the end of {}", waits.join(", ")),
    });
}

fn after(delay: Duration) -> String {
    match delay.is_zero() {
        true => String::new(),
        false => format!(", after {} s", delay.as_secs_f64()),
    }
}
