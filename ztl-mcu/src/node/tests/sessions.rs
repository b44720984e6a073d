//! How sessions begin, and which gateway holds the node.

use super::*;

#[test]
fn a_node_sends_awake_and_ignores_commands_until_a_hello() {
    with_node(|gateway, _| {
        assert_said(gateway.pass(0), &["Awake 77"]);
        assert_said(gateway.pass(1), &[]);
        assert_said(gateway.pass(250), &["Awake 77"]);
        assert_said(gateway.command(1, Body::Ping), &[]);
        assert_said(
            gateway.hello(5, 1),
            &["Welcome boot 77 replaces 0 highest 0 []"],
        );
        assert_said(
            gateway.hello(5, 1),
            &["Welcome boot 77 replaces 0 highest 0 []"],
        );
        assert_said(
            gateway.command(1, Body::Describe { index: 2 }),
            &["1 Component 2 c"],
        );
        assert_said(
            gateway.command(2, Body::Describe { index: 3 }),
            &["2 Refused no such component"],
        );
        assert_said(gateway.pass(300), &[]);
    });
}

#[test]
fn a_hello_with_an_invalid_session_is_ignored() {
    with_node(|gateway, _| {
        for number in [0, u32::MAX] {
            assert_said(
                gateway.hello(number, 1),
                &["Awake 77"][..usize::from(number == 0)],
            );
        }
        // With the boot id this would make a session of ones.
        assert_ne!(session_key(!77, 77), u32::MAX);
        assert_said(
            gateway.hello(!77, 1),
            &["Welcome boot 77 replaces 0 highest 0 []"],
        );
        assert_said(gateway.command(1, Body::Ping), &["1 Pong 0"]);
    });
}

#[test]
fn a_new_session_keeps_and_lists_the_tasks() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "500");
        assert_said(
            gateway.hello(6, 1),
            &["Welcome boot 77 replaces 5 highest 9 [9]", "Progress 9 "],
        );
        // A command of the session before fails its check.
        assert_said(
            gateway.send(key(5), 2, Body::Abort { task: LinkId(9) }),
            &[],
        );
        assert_said(gateway.command(1, Body::Ping), &["1 Pong 1"]);
    });
}

#[test]
fn another_gateway_is_rejected_during_a_session() {
    with_node(|gateway, _| {
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        gateway.pass(999);
        assert_said(
            gateway.hello(6, 2),
            &["0 Refused another gateway holds this device"],
        );
        assert_said(gateway.command(2, Body::Ping), &["2 Pong 0"]);
        gateway.pass(1000);
        assert_said(
            gateway.hello(6, 2),
            &["Welcome boot 77 replaces 5 highest 1 []"],
        );
    });
}

#[test]
fn repeated_gateway_takeovers_use_up_few_task_numbers() {
    with_node(|gateway, _| {
        gateway.hello(1, 1);
        for takeover in 2..70_000u32 {
            gateway.now = gateway.now + Duration::from_secs(1);
            let heard = gateway.hello(takeover, takeover.into());
            assert!(heard[0].starts_with("Welcome"), "{heard:?}");
        }
        // Each takeover uses one number: that of a `Start` that never arrived.
        let number = 70_000 - 2;
        let again = "a task of this or a later id was started already";
        assert_said(
            gateway.start(1, number, 0, "5"),
            &[&format!("1 Refused {again}")],
        );
        let next = number + 1;
        assert_said(
            gateway.start(2, next, 0, "5"),
            &[&format!("2 Started {next}")],
        );
    });
}

#[test]
fn a_node_accepts_a_hello_after_any_bytes() {
    with_node(|gateway, _| {
        // A small generator, so that the test needs no dependency and always plays the same.
        let mut seed = 1u32;
        for _ in 0..20_000 {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let byte = (seed >> 24) as u8;
            gateway.node.handle_bytes(gateway.now, &[byte]);
        }
        gateway.node.handle_bytes(gateway.now, &[0]);
        said(gateway.node, gateway.now, 0);
        let heard = gateway.hello(5, 1).join(",").to_string();
        assert!(heard.starts_with("Welcome"), "{heard}");
    });
}

#[test]
fn firmware_learns_whether_the_link_is_up_since_when_and_to_which_gateway() {
    with_node(|gateway, _| {
        let link = |gateway: &TestGateway<'_, [Motor<'_>; 3], 2>| {
            let link = gateway.node.link(gateway.now);
            link.map(|link| (link.gateway, link.since.as_millis()))
        };
        gateway.hello(5, 1);
        assert_eq!(link(gateway), None, "no command yet");
        gateway.command(1, Body::Ping);
        assert_eq!(link(gateway), Some((1, 10_000)));
        gateway.pass(999);
        // A restarted gateway.
        gateway.hello(6, 1);
        gateway.command(1, Body::Ping);
        assert_eq!(link(gateway), Some((1, 10_000)));
        gateway.now = gateway.now + Duration::from_millis(1000);
        assert_eq!(link(gateway), None, "also before the next turn");
        // Another one, also before the next turn.
        gateway.hello(7, 2);
        assert_eq!(link(gateway), None);
        gateway.command(1, Body::Ping);
        assert_eq!(link(gateway), Some((2, 11_999)));
        gateway.pass(1000);
        assert_eq!(link(gateway), None);
        gateway.command(2, Body::Ping);
        assert_eq!(link(gateway), Some((2, 12_999)));
    });
}
