//! Built-in handlers, for tests and first steps.

use std::io::{self, Write};
use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_std::describe::GoalRule;
use ztl_std::terminal::flat;
use ztl_yaml::{Fields, Node};

use crate::call::Call;
use crate::kind::{Effect, Job, JobContext, Kind, Outcome, Services, Start, StopReason};
use crate::reader::{ComponentContext, ConfigReader};
use crate::thread_job;

/// A handler that needs no program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BuiltIn {
    Echo,
    Sleep,
    Print,
}

/// All built-ins with their names. `docs/serve.md` has a row for each; a test compares them.
pub(crate) const BUILT_INS: [(&str, BuiltIn); 3] = [
    ("echo", BuiltIn::Echo),
    ("sleep", BuiltIn::Sleep),
    ("print", BuiltIn::Print),
];

/// Reads a built-in's name.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    _: Option<&mut Fields<'d>>,
    _: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let built_in = reader.yaml.one_of(node, &BUILT_INS)?;
    Some(Arc::new(built_in))
}

impl Kind for BuiltIn {
    fn goal_rule(&self) -> GoalRule {
        match self {
            Self::Echo | Self::Print => GoalRule::Any,
            Self::Sleep => GoalRule::Number {
                whole: false,
                least: Some(0.0),
                most: None,
                step: None,
                unit: None,
            },
        }
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        match *self {
            Self::Echo => Start::Ended(Outcome::Completed(call.goal.text.clone())),
            Self::Sleep => {
                let seconds = call.goal.text.parse().unwrap_or_default();
                let time = Duration::try_from_secs_f64(seconds).unwrap_or_default();
                task.effect(Effect::Accept);
                Start::Running(Box::new(Sleep(Instant::now().checked_add(time))))
            }
            Self::Print => thread_job::start(task, move |_, _| print(&call)),
        }
    }
}

/// Ends at this time; never, if no clock reaches it.
struct Sleep(Option<Instant>);

impl Job for Sleep {
    fn stop(&mut self, _: Instant, _: StopReason, effects: &mut Vec<Effect>) {
        effects.push(Effect::End(Outcome::Aborted("aborted".to_owned())));
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.0
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if self.0.is_some_and(|end| end <= now) {
            effects.push(Effect::End(Outcome::Completed("True".to_owned())));
        }
    }
}

/// Prints component and goal, a line each.
fn print(call: &Call) -> Outcome {
    let (component, goal) = (flat(&call.component), flat(&call.goal.text));
    let mut out = io::stdout().lock();
    let printed = writeln!(out, "component: {component}\ngoal: {goal}");
    match printed.and_then(|()| out.flush()) {
        Ok(()) => Outcome::Completed("True".to_owned()),
        Err(error) => Outcome::Failed(format!("cannot print: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_manual_lists_exactly_the_built_ins_and_their_goals() {
        let manual = include_str!("../../docs/serve.md");
        let header = "| built-in | goals | what it does |";
        let rows: Vec<&str> = manual
            .lines()
            .skip_while(|line| *line != header)
            .skip(2)
            .take_while(|line| line.starts_with('|'))
            .filter_map(|line| line.rsplitn(3, '|').nth(2))
            .collect();
        let expected = BUILT_INS.map(|(name, it)| format!("| `{name}` | {} ", it.goal_rule()));
        assert_eq!(rows, expected, "docs/serve.md, table of built-ins");
    }
}
