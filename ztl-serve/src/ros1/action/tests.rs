use std::any::Any;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::ros1::tests::component;

/// The action `actionlib/Test` with progress.
fn action() -> Arc<Action> {
    let component = component(
        "{ros1-action: /test, type: actionlib/TestAction, progress: 'at {feedback.feedback}', result: '{result.result} of 9'}",
    );
    let kind: Arc<dyn Any + Send + Sync> = Arc::clone(&component.kind) as _;
    kind.downcast().expect("an action")
}

fn number(number: i32) -> Vec<u8> {
    number.to_le_bytes().to_vec()
}

fn end(state: EndState, text: &str, result: Option<i32>) -> GoalEnd {
    GoalEnd {
        state,
        text: text.to_owned(),
        result: result.map(number),
    }
}

#[test]
fn each_end_of_a_goal_is_the_true_final_state() {
    let action = action();
    let said = |end, asked| action.outcome(end, asked);
    let client = Some(StopReason::Client);
    for (end, asked, expected) in [
        (
            end(EndState::Succeeded, "", Some(5)),
            None,
            Outcome::Completed("5 of 9".to_owned()),
        ),
        // It was too late for the abort.
        (
            end(EndState::Succeeded, "", Some(5)),
            client,
            Outcome::Completed("5 of 9".to_owned()),
        ),
        (
            end(EndState::Succeeded, "no result came", None),
            None,
            Outcome::Completed("SUCCEEDED, but the result was lost: no result came".to_owned()),
        ),
        (
            end(EndState::Aborted, "", Some(1)),
            client,
            Outcome::Failed("1 of 9".to_owned()),
        ),
        (
            end(EndState::Aborted, "stuck", Some(1)),
            None,
            Outcome::Failed("stuck; 1 of 9".to_owned()),
        ),
        (
            end(EndState::Aborted, "", None),
            None,
            Outcome::Failed("the action server has aborted the goal".to_owned()),
        ),
        (
            end(EndState::Preempted, "", None),
            client,
            Outcome::Aborted("aborted".to_owned()),
        ),
        (
            end(EndState::Preempted, "", None),
            None,
            Outcome::Aborted("cancelled or replaced by another client of the action".to_owned()),
        ),
        (
            end(EndState::Recalled, "", None),
            Some(StopReason::Server),
            Outcome::Aborted("the server was stopped".to_owned()),
        ),
        (
            end(EndState::Rejected, "too far", None),
            None,
            Outcome::Rejected("too far".to_owned()),
        ),
        (
            end(EndState::NotSent, "there are: /arm", None),
            None,
            Outcome::Rejected("there are: /arm".to_owned()),
        ),
        (
            end(EndState::NotSent, "cancelled", None),
            client,
            Outcome::Aborted("aborted before it began".to_owned()),
        ),
        (
            end(EndState::Unknown, "the server is gone", None),
            client,
            Outcome::Unknown("the server is gone".to_owned()),
        ),
    ] {
        assert_eq!(said(end.clone(), asked), expected, "{end:?} {asked:?}");
    }
    let odd = GoalEnd {
        state: EndState::Succeeded,
        text: String::new(),
        result: Some(vec![1]),
    };
    let Outcome::Completed(text) = said(odd, None) else {
        panic!("the server says SUCCEEDED");
    };
    assert!(text.starts_with("malformed actionlib/TestResult"), "{text}");
}

#[test]
fn feedback_is_reported_ten_times_a_second_and_an_abort_cancels() {
    let cancels = Arc::new(AtomicUsize::new(0));
    let counted = Arc::clone(&cancels);
    let mut now = Instant::now();
    let mut job = ActionJob {
        action: action(),
        cancel: Box::new(move || {
            counted.fetch_add(1, Ordering::Relaxed);
        }),
        asked: None,
        newest: None,
        next: now,
        leave_at: None,
    };
    let mut effects = Vec::new();
    for count in 0..=250 {
        let event = GoalEvent::Feedback(number(count));
        job.handle_event(now, JobEvent::Ros1(Event::Goal(event)), &mut effects);
        now += Duration::from_millis(1);
    }
    now += PROGRESS;
    assert!(job.poll_timeout().is_some_and(|next| next <= now));
    job.handle_timeout(now, &mut effects);
    let texts = effects.drain(..).map(|effect| match effect {
        Effect::Progress(text) => text,
        _ => String::new(),
    });
    // The last one counts.
    assert_eq!(
        texts.collect::<Vec<_>>(),
        ["at 0", "at 100", "at 200", "at 250"]
    );
    assert_eq!(job.poll_timeout(), None);
    job.stop(now, StopReason::Client, &mut effects);
    assert_eq!(cancels.load(Ordering::Relaxed), 1);
    assert!(effects.is_empty(), "only the action server ends the task");
    job.stop(now, StopReason::Server, &mut effects);
    job.handle_timeout(now + STOP_TIME, &mut effects);
    assert!(matches!(effects.as_slice(), [Effect::Leave]));
}
