use super::*;

const BOOT: u32 = 7;

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn rules(number: u64, until_ms: u64) -> InitRules {
    InitRules {
        id: InitId {
            client: ClientId([1; 16]),
            number,
        },
        boot: BOOT,
        until_ms,
    }
}

fn agent() -> Agent {
    Agent::new(at(0), BOOT, &[], true)
}

fn forwards(effects: &[AgentEffect]) -> usize {
    let is_forward = |effect: &&AgentEffect| matches!(effect, AgentEffect::Forward { .. });
    effects.iter().filter(is_forward).count()
}

fn verdicts(effects: &[AgentEffect]) -> Vec<(u64, Verdict)> {
    let verdict = |effect: &AgentEffect| match effect {
        AgentEffect::Reply { query, verdict } => Some((*query, verdict.clone())),
        _ => None,
    };
    effects.iter().filter_map(verdict).collect()
}

fn entries(effects: &[AgentEffect]) -> Vec<Entry> {
    let entry = |effect: &AgentEffect| match effect {
        AgentEffect::Record(entry) => Some(entry.clone()),
        _ => None,
    };
    effects.iter().filter_map(entry).collect()
}

const BODY: &[u8] = b"/lab;1;-1;open";
const ANSWER: &[u8] = b"/lab;1;42;opening";

#[test]
fn a_repeated_init_acts_once_and_gets_the_first_answer() {
    let mut agent = agent();
    let first = agent.handle_init(at(10), 1, rules(1, 2000), BODY, None);
    assert!(matches!(
        first.as_slice(),
        [
            AgentEffect::Record(Entry::Asked { .. }),
            AgentEffect::Forward { .. }
        ]
    ));
    assert_eq!(agent.handle_init(at(11), 2, rules(1, 2000), BODY, None), []);
    let said = ServerSaid::Answer(ANSWER.to_vec());
    let told = verdicts(&agent.handle_server(at(20), rules(1, 0).id, said));
    let answer = Verdict::Answer(ANSWER.to_vec());
    assert_eq!(told, [(1, answer.clone()), (2, answer.clone())]);
    let again = agent.handle_init(at(50_000), 3, rules(1, 2000), BODY, None);
    assert_eq!(verdicts(&again), [(3, answer)]);
    assert_eq!(forwards(&again), 0);
}

#[test]
fn a_late_a_replayed_and_a_foreign_init_does_not_act() {
    let mut agent = agent();
    let stale = |clock_ms| Verdict::Stale {
        boot: BOOT,
        clock_ms,
    };
    let late = agent.handle_init(at(3000), 1, rules(1, 2999), BODY, None);
    assert_eq!(verdicts(&late), [(1, stale(3000))]);
    // After its record was forgotten, nobody can tell what became of it.
    let replayed = agent.handle_init(at(100_000), 2, rules(1, 2999), BODY, None);
    assert!(matches!(
        verdicts(&replayed).as_slice(),
        [(2, Verdict::Unknown(_))]
    ));
    let other = InitRules {
        boot: 8,
        ..rules(1, 100_500)
    };
    let other = agent.handle_init(at(100_000), 4, other, BODY, None);
    assert!(matches!(
        verdicts(&other).as_slice(),
        [(4, Verdict::Unknown(_))]
    ));
}

#[test]
fn after_a_restart_the_journal_decides() {
    let mut before = agent();
    let mut journal = before.entries();
    journal.extend(entries(&before.handle_init(
        at(10),
        1,
        rules(1, 2000),
        BODY,
        Some(5),
    )));
    let said = ServerSaid::Answer(ANSWER.to_vec());
    journal.extend(entries(&before.handle_server(at(20), rules(1, 0).id, said)));

    let mut after = Agent::new(at(0), 8, &journal, true);
    let again = after.handle_init(at(1), 1, rules(1, 2000), BODY, None);
    assert_eq!(verdicts(&again), [(1, Verdict::Answer(ANSWER.to_vec()))]);
    // The one that never came is refused in the new boot, and that is certain.
    let next = after.handle_outcome(at(2), 2, rules(2, 2000));
    let never = Verdict::NotStarted("never seen".to_owned());
    assert_eq!(verdicts(&next), [(2, never)]);
    // With a journal that may lack entries, nothing is certain.
    let mut after = Agent::new(at(0), 8, &journal, false);
    let next = after.handle_outcome(at(2), 2, rules(2, 2000));
    assert!(matches!(
        verdicts(&next).as_slice(),
        [(2, Verdict::Unknown(_))]
    ));
}

#[test]
fn an_undecided_init_from_before_a_restart_is_asked_of_the_server() {
    let mut before = agent();
    let mut journal = before.entries();
    journal.extend(entries(&before.handle_init(
        at(10),
        1,
        rules(1, 2000),
        BODY,
        Some(5),
    )));
    for (told, expected) in [
        (&b"$ztl;1;42;opening"[..], Verdict::Answer(ANSWER.to_vec())),
        (
            // This agent does not know when it was forwarded, so the server may have forgotten it.
            b"$ztl;2;0;never seen since boot 5",
            Verdict::Unknown("whether it was started".to_owned()),
        ),
        (
            b"$ztl;2;0;never seen since boot 6",
            Verdict::Unknown("whether it was started".to_owned()),
        ),
        (
            b"$ztl;2;-1;No controller for scope: $ztl",
            Verdict::Unknown("whether it was started".to_owned()),
        ),
    ] {
        let mut after = Agent::new(at(0), 8, &journal, true);
        let id = rules(1, 0).id;
        let asked = after.handle_init(at(1), 1, rules(1, 2000), BODY, None);
        assert_eq!(asked, [AgentEffect::AskServer(id)]);
        let told = after.handle_server_outcome(at(2), id, Some(told));
        assert_eq!(verdicts(&told), [(1, expected)]);
    }
}

#[test]
fn an_init_that_was_given_up_never_acts() {
    let mut agent = agent();
    let never = agent.handle_outcome(at(10), 1, rules(1, 2000));
    let never_seen = Verdict::NotStarted("never seen".to_owned());
    assert_eq!(verdicts(&never), [(1, never_seen)]);
    let late = agent.handle_init(at(20), 2, rules(1, 2000), BODY, None);
    let given_up = Verdict::NotStarted(GIVEN_UP.to_owned());
    assert_eq!(verdicts(&late), [(2, given_up)]);
    let next = agent.handle_init(at(30), 3, rules(2, 2000), BODY, None);
    assert_eq!(forwards(&next), 1);
}

#[test]
fn an_init_that_is_valid_for_too_long_is_refused_and_not_sent_again_as_stale() {
    let mut agent = agent();
    let until = 10 + LONGEST_VALID_MS;
    let eternal = agent.handle_init(at(9), 1, rules(1, until), BODY, None);
    let [(1, Verdict::NotStarted(reason))] = &verdicts(&eternal)[..] else {
        panic!("{eternal:?}");
    };
    assert!(reason.starts_with("'until' is 60001 ms ahead"), "{reason}");
    // A copy of it comes when it is not too far ahead any more.
    let copy = agent.handle_init(at(10), 2, rules(1, until), BODY, None);
    assert_eq!(forwards(&copy), 0);
    let next = agent.handle_init(at(10), 3, rules(2, until), BODY, None);
    assert_eq!(forwards(&next), 1);
    let last = agent.handle_init(at(10), 4, rules(3, u64::MAX), BODY, None);
    assert_eq!(forwards(&last), 0);
}

/// The agent's entry cannot be written. Returns what it does instead.
fn unwritten(agent: &mut Agent, effects: Vec<AgentEffect>, marked: bool) -> Vec<AgentEffect> {
    let mut effects = effects.into_iter();
    let Some(AgentEffect::Record(entry)) = effects.next() else {
        panic!("no entry");
    };
    agent.handle_unwritten(&entry, marked, effects.collect())
}

#[test]
fn an_init_that_cannot_be_written_does_not_act_before_or_after_a_restart() {
    let mut before = agent();
    let journal = before.entries();
    let first = before.handle_init(at(10), 1, rules(1, 2000), BODY, None);
    let told = unwritten(&mut before, first, true);
    let refused = Verdict::NotStarted(UNWRITTEN.to_owned());
    assert_eq!(
        told,
        [AgentEffect::Reply {
            query: 1,
            verdict: refused.clone()
        }]
    );
    let again = before.handle_init(at(20), 2, rules(1, 2000), BODY, None);
    assert_eq!(verdicts(&again), [(2, refused)]);
    // What is given up is told so, too.
    let given_up = before.handle_outcome(at(20), 3, rules(2, 2000));
    let told = unwritten(&mut before, given_up, true);
    let never = Verdict::NotStarted("never seen".to_owned());
    assert_eq!(verdicts(&told), [(3, never)]);

    let journal = [&journal[..], &[Entry::Lacks]].concat();
    let mut after = Agent::new(at(0), 8, &journal, false);
    let rules_of = |boot, number, until_ms| InitRules {
        boot,
        ..rules(number, until_ms)
    };
    let copy = after.handle_init(at(1), 1, rules(1, 2000), BODY, None);
    assert!(matches!(verdicts(&copy)[..], [(1, Verdict::Unknown(_))]));
    for number in [1, 2] {
        let repeated = after.handle_init(at(1), 2, rules_of(8, number, 2000), BODY, None);
        assert!(matches!(
            repeated[0],
            AgentEffect::Record(Entry::GivenUp(_))
        ));
        assert!(matches!(
            verdicts(&repeated)[..],
            [(2, Verdict::NotStarted(_))]
        ));
    }
    // Another restart does not forget that, nor what it refused.
    let mut after = Agent::new(at(0), 9, &after.entries(), true);
    let repeated = after.handle_init(at(1), 3, rules_of(9, 2, 2000), BODY, None);
    assert_eq!(
        verdicts(&repeated),
        [(3, Verdict::NotStarted(GIVEN_UP.to_owned()))]
    );
    let other = after.handle_init(at(1), 4, rules_of(9, 3, 2000), BODY, None);
    assert_eq!(forwards(&other), 0);
    // Everything that it lacked would be forgotten now.
    assert_eq!(after.poll_timeout(), Some(at(KEEP_MS)));
    let whole = [AgentEffect::Record(Entry::Whole)];
    assert_eq!(after.handle_timeout(at(KEEP_MS)), whole);
    let next = after.handle_init(at(KEEP_MS), 5, rules_of(9, 4, 62_000), BODY, None);
    assert_eq!(forwards(&next), 1);
    let journal = [after.entries(), vec![Entry::Lacks, Entry::Whole]].concat();
    assert_eq!(Agent::new(at(0), 10, &journal, true).lacks_until, None);
}

#[test]
fn nothing_is_promised_of_an_init_if_a_restart_would_forget_it() {
    let is_unknown = |effects: &[AgentEffect], query| {
        let told = verdicts(effects);
        let [(known, Verdict::Unknown(_))] = told[..] else {
            panic!("{told:?}");
        };
        assert_eq!((known, effects.len()), (query, 1));
    };
    let mut agent = agent();
    let first = agent.handle_init(at(10), 1, rules(5, 2000), BODY, None);
    is_unknown(&unwritten(&mut agent, first, false), 1);
    for number in [4, 5] {
        let again = agent.handle_init(at(20), 2, rules(number, 2000), BODY, None);
        is_unknown(&again, 2);
    }
    is_unknown(&agent.handle_outcome(at(20), 3, rules(5, 2000)), 3);
    let given_up = agent.handle_outcome(at(20), 4, rules(6, 2000));
    is_unknown(&unwritten(&mut agent, given_up, false), 4);
    let late = agent.handle_init(at(30), 5, rules(6, 2000), BODY, None);
    is_unknown(&late, 5);
}

#[test]
fn an_undecided_query_is_answered_in_bounded_time() {
    let mut agent = agent();
    agent.handle_init(at(0), 1, rules(1, 2000), BODY, None);
    assert_eq!(agent.poll_timeout(), Some(at(1900)));
    let late = agent.handle_timeout(at(1900));
    assert!(matches!(
        verdicts(&late).as_slice(),
        [(1, Verdict::Unknown(_))]
    ));
    assert_eq!(agent.poll_timeout(), None);
}

#[test]
fn clients_and_bytes_are_bounded() {
    let mut agent = agent();
    for client in 0..MOST_CLIENTS as u128 + 1 {
        let mut rules = rules(1, 2000);
        rules.id.client = ClientId(client.to_be_bytes());
        let effects = agent.handle_init(at(0), 1, rules, BODY, None);
        assert_eq!(
            forwards(&effects),
            usize::from(client < MOST_CLIENTS as u128)
        );
        if client == MOST_CLIENTS as u128 {
            // It is not remembered, so nothing is promised.
            let full = Verdict::Unknown(FULL.to_owned());
            assert_eq!(verdicts(&effects), [(1, full)]);
        }
    }
    for record in 0..MOST_CLIENTS as u128 {
        let id = InitId {
            client: ClientId(record.to_be_bytes()),
            number: 1,
        };
        agent.handle_server(at(1), id, ServerSaid::Answer(ANSWER.to_vec()));
    }
    agent.handle_timeout(at(2000 + KEEP_MS));
    assert_eq!((agent.records.len(), agent.bytes), (0, 0));
}

#[test]
fn what_the_server_has_never_seen_was_not_started_only_while_it_remembers() {
    let not_started = Verdict::NotStarted("the robot's server did not get it".to_owned());
    let unknown = Verdict::Unknown("whether it was started".to_owned());
    for (answered, expected) in [(60_009, not_started), (60_010, unknown)] {
        let mut agent = agent();
        let id = rules(1, 0).id;
        let sent = agent.handle_init(at(10), 1, rules(1, 2000), BODY, Some(5));
        assert_eq!(forwards(&sent), 1);
        let asked = agent.handle_server(at(1000), id, ServerSaid::Silence);
        assert_eq!(asked, [AgentEffect::AskServer(id)]);
        let told = b"$ztl;2;0;never seen since boot 5";
        let told = agent.handle_server_outcome(at(answered), id, Some(told));
        assert_eq!(verdicts(&told), [(1, expected)]);
    }
}
