//! Components that are polled without a task.

use super::*;

/// A control loop: counts its polls, brakes for 30 ms on the way to its safe state.
#[derive(Default)]
struct Loop {
    every: u64,
    tick: Instant,
    polls: Grown<u64>,
    runs: bool,
    brakes_until: Option<Instant>,
    /// Says that it runs also without a task.
    always_runs: bool,
}

impl Component for Loop {
    fn offer(&self) -> Offer<'_> {
        Offer::new("loop")
    }

    fn check(&self, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        Ok(())
    }

    fn start(&mut self, _: Instant, _: &str, _: &mut Report<'_>) -> Result<(), Refused> {
        self.runs = true;
        Ok(())
    }

    fn poll(&mut self, now: Instant, _: &mut Report<'_>) -> Run {
        self.polls.push(now.as_millis());
        self.tick = now + Duration::from_millis(self.every);
        let brakes = self.brakes_until.is_some_and(|until| now < until);
        if self.runs || brakes || self.always_runs {
            return Run::Running;
        }
        Run::Aborted
    }

    fn abort(&mut self, _: Instant) {
        self.runs = false;
    }

    fn make_safe(&mut self, now: Instant) {
        self.runs = false;
        self.brakes_until = Some(now + Duration::from_millis(30));
    }

    fn poll_timeout(&self, _: Instant) -> Instant {
        Instant::NEVER
    }

    fn next_tick(&self) -> Instant {
        if self.every == 0 {
            return Instant::NEVER;
        }
        self.tick
    }
}

type Loops = [Loop; 2];

fn with_loops(play: impl FnOnce(&mut TestGateway<'_, Loops, 2>)) {
    let [fast, slow] = [10, 35].map(|every| Loop {
        every,
        ..Loop::default()
    });
    let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), [fast, slow]);
    play(&mut gateway(&mut node));
}

/// The polls of a component since the last call, in ms since `gateway.now` was 10 s.
fn polls(gateway: &mut TestGateway<'_, Loops, 2>, index: usize) -> Grown<u64> {
    let polls = core::mem::take(&mut gateway.node.components_mut()[index].polls);
    polls.iter().map(|at| at - 10_000).collect()
}

/// Turns of a main loop that sleeps as long as the node allows.
fn sleep_for(gateway: &mut TestGateway<'_, Loops, 2>, millis: u64) {
    let end = gateway.now + Duration::from_millis(millis);
    while gateway.now < end {
        gateway.node.handle_timeout(gateway.now);
        said(gateway.node, gateway.now, gateway.session);
        let next = gateway.node.poll_timeout(gateway.now);
        assert!(next > gateway.now, "sleeps");
        gateway.now = next.min(end);
    }
}

#[test]
fn each_component_is_polled_at_its_own_interval_with_and_without_a_task() {
    with_loops(|gateway| {
        sleep_for(gateway, 40);
        assert_eq!(polls(gateway, 0), [0, 10, 20, 30]);
        assert_eq!(polls(gateway, 1), [0, 35]);
        gateway.hello(5, 1);
        gateway.start(1, 9, 0, "on");
        sleep_for(gateway, 40);
        // Once more at once, because its task has begun.
        assert_eq!(polls(gateway, 0), [40, 50, 60, 70]);
        assert_eq!(polls(gateway, 1), [70]);
        assert_said(
            gateway.command(2, Body::Abort { task: LinkId(9) }),
            &["2 Aborting 9"],
        );
        assert!(gateway.pass(0).contains(&"Ended 9 ABORTED ".to_string()));
        // Asked for at any time.
        gateway.node.components_mut()[1].every = 0;
        sleep_for(gateway, 30);
        assert_eq!(polls(gateway, 0), [80, 90, 100]);
        assert_eq!(polls(gateway, 1), []);
    });
}

#[test]
fn ticks_go_on_until_the_component_is_safe_and_after() {
    with_loops(|gateway| {
        gateway.hello(5, 1);
        gateway.command(1, Body::Ping);
        sleep_for(gateway, 1000);
        polls(gateway, 0);
        // The link is lost now.
        sleep_for(gateway, 20);
        assert!(polls(gateway, 0).len() >= 2);
        let busy = "busy going to its safe state";
        assert_eq!(gateway.start(2, 9, 0, "on")[0], format!("2 Refused {busy}"));
        sleep_for(gateway, 30);
        assert!(polls(gateway, 0).len() >= 3);
        assert_eq!(gateway.start(3, 9, 0, "on")[0], "3 Started 9");
    });
}

#[test]
fn a_tick_that_says_running_refuses_no_task() {
    with_loops(|gateway| {
        gateway.node.components_mut()[0].always_runs = true;
        gateway.hello(5, 1);
        sleep_for(gateway, 40);
        assert_eq!(polls(gateway, 0).len(), 4);
        assert_eq!(gateway.start(1, 9, 0, "on")[0], "1 Started 9");
    });
}

#[test]
fn components_of_any_collection_are_ticked() {
    fn ticked(components: impl Components) -> u64 {
        let mut node = Node::<_, 2, 128>::new(Identity::new("desk", "1", 77), components);
        node.handle_timeout(Instant::from_millis(10_000));
        node.next_move().as_millis()
    }
    let ticking = || Loop {
        every: 7,
        ..Loop::default()
    };
    let resting = Loop::default;
    let (mut one, mut other) = (resting(), ticking());
    assert_eq!(ticked([resting(), ticking()]), 10_007);
    assert_eq!(ticked((resting(), ticking())), 10_007);
    assert_eq!(ticked(&mut [ticking()]), 10_007);
    assert_eq!(ticked((resting(), &mut other)), 10_007);
    let mut list: [&mut dyn Component; 2] = [&mut one, &mut other];
    assert_eq!(ticked(list.as_mut_slice()), 10_007);
}
