//! `ros1-action`: a goal of actionlib. The final state is that of the action server.

use std::sync::Arc;
use std::time::{Duration, Instant};

use ztl_ros1::message::ActionType;
use ztl_ros1::{ActionTypes, EndState, GoalEnd, GoalEvent};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node};

use super::Event;
use super::connection::{Connection, wire};
use super::message::{MessageTemplate, rule_of_goals};
use super::shown::ShownMessage;
use super::trajectory::{MOVE_BASE, MoveBase, TRAJECTORY_ACTION, Trajectory};
use super::used_name::UsedType;
use crate::call::Call;
use crate::kind::{
    Effect, Job, JobContext, JobEvent, Kind, Outcome, STOP_TIME, Services, Start, StopReason,
};
use crate::reader::{ComponentContext, ConfigReader};

/// The shortest time between two progress texts: feedback may come a thousand times a second.
const PROGRESS: Duration = Duration::from_millis(100);

/// An action of a robot.
#[derive(Debug)]
pub(crate) struct Action {
    connection: Arc<Connection>,
    name: String,
    types: ActionType,
    goal: GoalSource,
    progress: Option<ShownMessage>,
    result: ShownMessage,
}

/// What makes the goal of actionlib.
#[derive(Debug)]
enum GoalSource {
    Message(MessageTemplate),
    Trajectory(Trajectory),
    MoveBase(MoveBase),
}

/// Reads an action.
pub(crate) fn read<'d>(
    reader: &mut ConfigReader<'d>,
    node: &'d Node,
    fields: Option<&mut Fields<'d>>,
    context: ComponentContext<'_>,
) -> Option<Arc<dyn Kind>> {
    let fields = fields?;
    let name = "/arm_controller/follow_joint_trajectory";
    let example = "type: move_base_msgs/MoveBaseAction";
    let (name, types) = reader.ros1_typed_name(node, fields, name, example, UsedType::action);
    let message = fields.optional("message");
    let joints = fields.optional("joints");
    let frame = fields.optional("frame");
    let progress = fields.optional("progress");
    let result = fields.optional("result");
    let trajectory = joints.and_then(|node| Trajectory::read(reader, node, fields));
    let types = types?;
    let short_forms = [
        (joints, "joints", TRAJECTORY_ACTION),
        (frame, "frame", MOVE_BASE),
    ];
    for (node, key, of) in short_forms {
        if let Some(node) = node.filter(|_| types.name != of || message.is_some()) {
            let mistake = format!("{key} has an effect only with type: {of}, without message");
            reader.yaml.wrong(node, mistake);
        }
    }
    let goal = match (message, joints) {
        (None, Some(_)) => GoalSource::Trajectory(trajectory?),
        (None, None) if types.name == MOVE_BASE => {
            GoalSource::MoveBase(MoveBase::read(reader, frame)?)
        }
        _ => GoalSource::Message(reader.message_or_goal(message, &types.goal, context.rule, None)),
    };
    let progress = progress.map(|node| reader.shown_message(node, "feedback", &types.feedback));
    let result = result.map(|node| reader.shown_message(node, "result", &types.result));
    let whole = || Some(ShownMessage::whole(&types.result));
    Some(Arc::new(Action {
        connection: Arc::clone(&reader.ros1.connection),
        name: name?,
        goal,
        progress: progress.flatten(),
        result: result.unwrap_or_else(whole)?,
        types,
    }))
}

impl Action {
    pub(super) fn content(&self, call: &Call) -> Result<Vec<u8>, String> {
        match &self.goal {
            GoalSource::Message(message) => message.fill(call),
            GoalSource::Trajectory(trajectory) => trajectory.goal(&self.types.goal, call),
            GoalSource::MoveBase(goal) => goal.goal(&self.types.goal, call),
        }
    }

    #[cfg(test)]
    pub(super) const fn goal_type(&self) -> &Arc<ztl_ros1::message::MessageType> {
        &self.types.goal
    }

    fn client(&self) -> Result<ztl_ros1::ActionClient, String> {
        let types = ActionTypes {
            goal: wire(&self.types.action_goal),
            feedback: wire(&self.types.action_feedback),
            result: wire(&self.types.action_result),
        };
        let client = self.connection.node()?.action(&self.name, types);
        client.map_err(|error| error.to_string())
    }

    /// The outcome of a task for the end of its goal.
    fn outcome(&self, end: GoalEnd, asked: Option<StopReason>) -> Outcome {
        let GoalEnd {
            state,
            text,
            result,
        } = end;
        let result = result.map(|bytes| self.result.text(&bytes).unwrap_or_else(|error| error));
        // What the server says, and the result if that says more.
        let said = |default: &str| match (text.as_str(), &result) {
            ("", Some(result)) if !self.types.result.fields().is_empty() => result.clone(),
            ("", _) => default.to_owned(),
            (text, Some(result)) if !self.types.result.fields().is_empty() => {
                format!("{text}; {result}")
            }
            (text, _) => text.to_owned(),
        };
        let preempted = match asked {
            Some(why) => why.to_string(),
            None => "cancelled or replaced by another client of the action".to_owned(),
        };
        match state {
            EndState::Succeeded => Outcome::Completed(match result {
                Some(result) => result,
                None => format!("SUCCEEDED, but the result was lost: {text}"),
            }),
            EndState::Aborted => Outcome::Failed(said("the action server has aborted the goal")),
            EndState::Preempted | EndState::Recalled => Outcome::Aborted(said(&preempted)),
            EndState::Rejected => {
                Outcome::Rejected(said("the action server has rejected the goal"))
            }
            EndState::NotSent if asked.is_some() => {
                Outcome::Aborted("aborted before it began".to_owned())
            }
            EndState::NotSent => Outcome::Rejected(text),
            EndState::Unknown => Outcome::Unknown(text),
        }
    }
}

impl Kind for Action {
    fn goal_rule(&self) -> GoalRule {
        match &self.goal {
            GoalSource::Message(message) => rule_of_goals(&message.goals()),
            GoalSource::Trajectory(trajectory) => trajectory.goal_rule(),
            GoalSource::MoveBase(_) => MoveBase::goal_rule(),
        }
    }

    fn at_once(&self) -> usize {
        match self.goal {
            GoalSource::Message(_) => 16,
            // A controller replaces a motion by the next one.
            GoalSource::Trajectory(_) | GoalSource::MoveBase(_) => 1,
        }
    }

    fn needs_fields(&self) -> bool {
        match &self.goal {
            GoalSource::Message(message) => message.needs_fields(),
            GoalSource::Trajectory(_) => false,
            GoalSource::MoveBase(_) => true,
        }
    }

    fn check(&self, call: &Call) -> Result<(), String> {
        self.content(call).map(drop)
    }

    fn prepare(&self) {
        // Connects to the action server. If that fails, each task says why.
        let _ = self.client();
    }

    fn start(self: Arc<Self>, call: Arc<Call>, task: JobContext, _: &Services) -> Start {
        let sent = self.content(&call).and_then(|content| {
            let on_event = move |event| task.event(JobEvent::Ros1(Event::Goal(event)));
            Ok(self.client()?.send_goal(content, on_event))
        });
        match sent {
            Ok(goal) => Start::Running(Box::new(ActionJob {
                action: self,
                cancel: Box::new(move || goal.cancel()),
                asked: None,
                newest: None,
                next: Instant::now(),
                leave_at: None,
            })),
            Err(reason) => Start::Ended(Outcome::Rejected(reason)),
        }
    }
}

/// A goal in progress.
struct ActionJob {
    action: Arc<Action>,
    cancel: Box<dyn Fn() + Send>,
    /// Why it was cancelled, if it was.
    asked: Option<StopReason>,
    /// The newest feedback that was not reported.
    newest: Option<Vec<u8>>,
    /// When the next progress may be reported.
    next: Instant,
    /// When the server stops without the final state.
    leave_at: Option<Instant>,
}

impl Job for ActionJob {
    fn stop(&mut self, now: Instant, why: StopReason, _: &mut Vec<Effect>) {
        self.asked.get_or_insert(why);
        (self.cancel)();
        if why == StopReason::Server {
            self.leave_at = now.checked_add(STOP_TIME);
        }
    }

    fn handle_event(&mut self, now: Instant, event: JobEvent, effects: &mut Vec<Effect>) {
        match event {
            JobEvent::Ros1(Event::Goal(GoalEvent::Accepted)) => effects.push(Effect::Accept),
            JobEvent::Ros1(Event::Goal(GoalEvent::Feedback(bytes)))
                if self.action.progress.is_some() =>
            {
                self.newest = Some(bytes);
                self.report(now, effects);
            }
            JobEvent::Ros1(Event::Goal(GoalEvent::Ended(end))) => {
                effects.push(Effect::End(self.action.outcome(end, self.asked)));
            }
            _ => {}
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let next = self.newest.is_some().then_some(self.next);
        next.into_iter().chain(self.leave_at).min()
    }

    fn handle_timeout(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        self.report(now, effects);
        if self.leave_at.is_some_and(|at| at <= now) {
            self.leave_at = None;
            effects.push(Effect::Leave);
        }
    }
}

impl ActionJob {
    /// Reports the newest feedback, unless that was done a short time ago.
    fn report(&mut self, now: Instant, effects: &mut Vec<Effect>) {
        if now < self.next {
            return;
        }
        let (Some(bytes), Some(shown)) = (self.newest.take(), &self.action.progress) else {
            return;
        };
        self.next = now + PROGRESS;
        let text = shown.text(&bytes).unwrap_or_else(|error| error);
        effects.push(Effect::Progress(text));
    }
}

#[cfg(test)]
mod tests;
