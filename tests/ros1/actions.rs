//! Actions of a real action server end in their true state.

use std::sync::mpsc::channel;
use std::time::Duration;

use ztl_ros1::{EndState, GoalEnd, GoalEvent, Pace};
use ztl_tests::lab::{PATIENCE, Process, in_time};

use crate::rig::{
    Master, Running, connected, not_sent, of, test_action, unique, wait, wait_for_server, within,
};

/// An answer after the 1.5 s for which a goal waits is due within this time.
const SOON: Duration = Duration::from_secs(5);

#[test]
fn each_final_state_of_the_server_arrives_with_its_text_and_result() {
    let master = Master::shared();
    let name = unique("states");
    let mut robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);

    let done = Running::send(&action, 1);
    done.accepted();
    done.ends(EndState::Succeeded, "done", Some(10));

    let broken = Running::send(&action, 2);
    broken.accepted();
    broken.ends(EndState::Aborted, "broken", Some(20));

    Running::send(&action, 3).ends(EndState::Rejected, "no", Some(30));

    // Feedback has a connection of its own, which a result overtakes: this goal ends only after its feedback came.
    let told = Running::send(&action, 4);
    told.accepted();
    assert_eq!(told.next(), GoalEvent::Feedback(vec![5, 0, 0, 0]));
    robot.write_line("finish");
    told.ends(EndState::Succeeded, "told", Some(7));
}

#[test]
fn a_cancel_preempts_or_recalls() {
    let master = Master::shared();
    let name = unique("cancels");
    let robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);

    let running = Running::send(&action, 4);
    running.accepted();
    running.goal.cancel();
    running.ends(EndState::Preempted, "stopped", Some(-1));

    let waiting = Running::send(&action, 5);
    robot.wait_for("goal 5");
    waiting.goal.cancel();
    waiting.ends(EndState::Recalled, "stopped", Some(-1));

    // The cancel follows at once, and the topics have connections of their own: it may overtake the goal.
    for _ in 0..20 {
        let quick = Running::send(&action, 4);
        quick.goal.cancel();
        let state = quick.end().state;
        assert!(
            [EndState::Preempted, EndState::Recalled].contains(&state),
            "{state:?}"
        );
    }
}

#[test]
fn a_goal_that_another_client_preempts_is_told_as_preempted() {
    let master = Master::shared();
    let name = unique("preempted");
    let mut robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let running = Running::send(&action, 4);
    running.accepted();
    robot.write_line("preempt");
    running.ends(EndState::Preempted, "by another", Some(8));
}

#[test]
fn a_result_that_a_proxy_loses_leaves_the_true_state() {
    let master = Master::shared();
    let [real, name] = [unique("real"), unique("lossy")];
    let _robot = master.action(&real, &real);
    let proxy = master.robot(&["proxy", &name, &real, &name]);
    let node = master.node();
    let action = connected(&node, &name);
    let running = Running::send(&action, 1);
    running.accepted();
    running.ends(EndState::Succeeded, "done", None);
    proxy.wait_for("lost 10");
    Running::send(&action, 2).ends(EndState::Aborted, "broken", None);
    proxy.wait_for("lost 20");
    Running::send(&action, 3).ends(EndState::Rejected, "no", None);
    let cancelled = Running::send(&action, 4);
    cancelled.accepted();
    cancelled.goal.cancel();
    cancelled.ends(EndState::Preempted, "stopped", None);
    proxy.wait_for("lost -1");
}

#[test]
fn a_goal_that_the_server_never_shows_has_an_unknown_outcome() {
    let master = Master::shared();
    let name = unique("deaf");
    let _robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let end = Running::send(&action, 7).end();
    assert_eq!(end.state, EndState::Unknown);
    assert!(
        end.text.contains("has not shown the goal in time"),
        "{}",
        end.text
    );
}

#[test]
fn a_wrong_name_is_answered_soon_with_those_that_exist() {
    let master = Master::shared();
    let name = unique("right");
    let _robot = master.action(&name, &name);
    let node = master.node();
    let action = node.action("/wrong", test_action()).unwrap();
    let there = format!("/{name} (actionlib/TestAction)");
    let told = "no action server has the name /wrong; there are: ";
    let text = in_time(SOON, || not_sent(&action, &[told, &there]));
    assert!(text.starts_with(told), "{text}");
    assert!(!text.contains("/wrong ("), "{text}");
    assert!(!node.survey().unwrap().actions.contains_key("/wrong"));
}

#[test]
fn another_definition_of_the_goal_is_named() {
    let master = Master::shared();
    let name = unique("old");
    let _robot = master.action(&name, &name);
    let node = master.node();
    let mut types = test_action();
    types.result.md5 = "0123456789abcdef0123456789abcdef".to_owned();
    let action = node.action(&name, types).unwrap();
    let told = format!("the action server /{name} of /{name} is not connected to result: ");
    let text = not_sent(&action, &[&told, "3d669e3a63aa986c667ea7b0f46ce85e"]);
    assert!(text.starts_with(&told), "{text}");

    // Its server only receives it.
    let node = master.node();
    let mut types = test_action();
    types.goal.md5 = "0123456789abcdef0123456789abcdef".to_owned();
    let action = node.action(&name, types).unwrap();
    let told = format!(
        "the action server /{name} of /{name} is not connected to goal: /{name} has another definition of the type: "
    );
    let text = not_sent(&action, &[&told, "348369c5b403676156094e8c159720bf"]);
    assert!(text.starts_with(&told), "{text}");
    let again = in_time(Duration::from_secs(3), || not_sent(&action, &[&text]));
    assert_eq!(again, text);
}

#[test]
fn two_servers_under_one_name_get_no_goal() {
    let master = Master::shared();
    let topic = unique("twice");
    let [one, other] = [unique("one"), unique("other")];
    let first = master.action(&one, &topic);
    let second = master.action(&other, &topic);
    let node = master.node();
    let action = node.action(&topic, test_action()).unwrap();
    let parts = ["more than one server", &one, &other];
    // Until both are connected, one of them may get goals.
    not_sent(&action, &parts);
    let goals = || [&first, &second].map(|robot: &Process| robot.stdout().matches("goal").count());
    let before = goals();
    not_sent(&action, &parts);
    assert_eq!(goals(), before);
}

#[test]
fn a_second_server_is_noticed_also_when_a_stream_used_the_status_before() {
    let master = Master::shared();
    let name = unique("streamed");
    let _robot = master.action(&name, &name);
    let node = master.node();
    let (told, senders) = channel();
    let topic = format!("/{name}/status");
    let status = of(
        "actionlib_msgs/GoalStatusArray",
        "8b2b82f13216d0a8ea88bd3af735e619",
    );
    let _stream = node.subscribe(&topic, status.clone(), Pace::Irregular, move |sender, _| {
        let _ = told.send(sender.to_owned());
    });
    let action = connected(&node, &name);
    let other = master.node();
    let second = other.publisher(&topic, status, false).unwrap();
    wait("the second server is connected", || {
        // A header without a stamp or frame, and no goals.
        second.publish(vec![0; 20]);
        senders.try_iter().any(|sender| sender == other.name())
    });
    let end = Running::send(&action, 1).end();
    assert_eq!(end.state, EndState::NotSent, "{end:?}");
    assert!(end.text.contains("more than one server"), "{end:?}");
}

/// Checks the end of a goal whose server was accepting it when it was killed or stopped.
#[track_caller]
fn is_unknown(end: &GoalEnd, name: &str, reasons: &[&str]) {
    assert_eq!(end.state, EndState::Unknown);
    // Its feedback may have come before that, and its status not.
    let unseen = "has not shown the goal in time; a cancel was sent";
    let mut expected = reasons.iter().chain([&unseen]);
    let is_expected =
        expected.any(|reason| end.text == format!("the action server /{name} {reason}"));
    assert!(is_expected, "{}", end.text);
}

#[test]
fn a_killed_server_is_gone_and_a_restarted_one_does_not_know_the_goal() {
    let master = Master::shared();
    let name = unique("killed");
    let mut robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let running = Running::send(&action, 4);
    running.accepted();
    robot.kill();
    is_unknown(&running.end(), &name, &["is gone"]);

    let mut robot = master.action(&name, &name);
    wait_for_server(&action);
    let again = Running::send(&action, 4);
    again.accepted();
    robot.kill();
    let robot = master.action(&name, &name);
    // Starting it may take longer than a silence may.
    let reasons = ["was restarted and does not know the goal", "is gone"];
    is_unknown(&again.end(), &name, &reasons);
    wait_for_server(&action);
    assert!(!robot.stdout().contains("goal 4"));
}

#[test]
fn a_server_that_was_stopped_for_a_while_loses_no_goal() {
    let master = Master::shared();
    let name = unique("stopped");
    let mut robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let running = Running::send(&action, 4);
    running.accepted();
    robot.signal("STOP");
    // Longer than a closed connection may be silent, and shorter than an open one may.
    std::thread::sleep(Duration::from_secs(6));
    robot.signal("CONT");
    robot.write_line("finish");
    running.ends(EndState::Succeeded, "told", Some(7));
}

#[test]
fn a_goal_of_unknown_outcome_is_cancelled_when_its_server_is_back() {
    let master = Master::shared();
    let name = unique("hung");
    let robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let running = Running::send(&action, 4);
    running.accepted();
    robot.signal("STOP");
    is_unknown(&running.end(), &name, &["is silent"]);
    robot.signal("CONT");
    robot.wait_for("cancel ");
}

#[test]
fn fifty_actions_run_at_once() {
    let master = Master::shared();
    let name = unique("many");
    let topics: Vec<String> = (0..50).map(|number| format!("{name}/a{number}")).collect();
    let mut arguments = vec!["action", &name];
    arguments.extend(topics.iter().map(String::as_str));
    let _robot = master.robot(&arguments);
    let node = master.node();
    let open = |topic: &String| node.action(topic, test_action()).unwrap();
    let actions: Vec<_> = topics.iter().map(open).collect();
    actions.iter().for_each(wait_for_server);
    let goals: Vec<_> = actions.iter().map(|of| Running::send(of, 4)).collect();
    goals.iter().for_each(Running::accepted);
    for goal in &goals {
        goal.goal.cancel();
    }
    for goal in goals {
        goal.ends(EndState::Preempted, "stopped", Some(-1));
    }
}

#[test]
fn fifty_goals_at_once_and_a_thousand_feedbacks_a_second() {
    let master = Master::shared();
    let name = unique("busy");
    let mut robot = master.action(&name, &name);
    let node = master.node();
    let action = connected(&node, &name);
    let goals: Vec<_> = (0..50).map(|_| Running::send(&action, 1)).collect();
    for goal in goals {
        goal.ends(EndState::Succeeded, "done", Some(10));
    }
    let fed = Running::send(&action, 1000);
    fed.accepted();
    // A slow publisher drops some itself, but not the last one.
    let mut last = -1;
    while last < 999 {
        let GoalEvent::Feedback(content) = fed.next() else {
            panic!("it ended after feedback {last}");
        };
        let number = i32::from_le_bytes(content[..].try_into().unwrap());
        assert!(number > last, "{number} after {last}");
        last = number;
    }
    robot.write_line("finish");
    fed.ends(EndState::Succeeded, "told", Some(7));
}

#[test]
fn two_nodes_share_an_action() {
    let master = Master::shared();
    let name = unique("shared");
    let _robot = master.action(&name, &name);
    let nodes = [master.node(), master.node()];
    assert_ne!(nodes[0].name(), nodes[1].name());
    let actions = nodes
        .each_ref()
        .map(|node| node.action(&name, test_action()).unwrap());
    // Both are connected: rospy drops connections that are made at the same time.
    actions.iter().for_each(wait_for_server);
    let [one, other] = actions.each_ref().map(|action| Running::send(action, 4));
    one.accepted();
    other.accepted();
    one.goal.cancel();
    one.ends(EndState::Preempted, "stopped", Some(-1));
    within(PATIENCE, || {
        other.goal.cancel();
        other.ends(EndState::Preempted, "stopped", Some(-1));
    });
}
