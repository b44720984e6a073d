//! Files with and without mistakes.

use std::any::Any;
use std::time::Duration;

use ztl_std::describe::GoalField;
use ztl_tests::garbage::Garbage;

use super::*;
use crate::built_in::BuiltIn;
use crate::forward::Forward;
use crate::program::settings::{Abort, AbortBy, Program, ResultKind};
use crate::stream::Origin;
use crate::stream::splitter::Framing;

fn parse(text: &str) -> Result<Config, Diagnostics> {
    let document = Document::parse("robot.yaml", text.as_bytes())?;
    Config::read(&document, Path::new("/"))
}

/// The only component of a file.
#[track_caller]
fn component_of(text: &str) -> Arc<ComponentConfig> {
    let text = format!("scopes: {{/r: {{h: {{c: {text}}}}}}}");
    let config = parse(&text).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    let scope = config.scopes.first().expect("a scope");
    let component = scope.configs().next().expect("a component");
    Arc::clone(component.2)
}

#[track_caller]
fn kind_of<K: Clone + 'static>(component: &ComponentConfig) -> K {
    let kind: &dyn Any = &*component.kind;
    let kind = kind.downcast_ref::<K>();
    kind.unwrap_or_else(|| panic!("{component:?}")).clone()
}

#[track_caller]
fn stream_program(stream: &StreamConfig) -> &Program {
    match &stream.origin {
        Origin::Program(program) => program,
        Origin::Topic(_) | Origin::Signal(_) | Origin::Event(_) => panic!("{stream:?}"),
    }
}

#[track_caller]
fn program_of(text: &str) -> Program {
    kind_of(&component_of(text))
}

const WHOLE: &str = "\
port: 12345
bind: 127.0.0.1
at-once: 20
scopes:
  /robot:
    tts:
      say:
        run: [sh, -c, '--text={goal.text}', '{goal.speed}', '{id}']
        directory: /tmp
        environment: {LANG: C, EMPTY: , QUOTED: ''}
        user: root
        dashes: rejected
        limit: 30 s
        output: 4 KiB
        at-once: 2
        busy: queue 3
        goal: {fields: {text: {longest: 80}, speed: {type: whole, least: 0, most: 9, default: 5}}}
        rejected-by: [2, 64]
        decide: 500 ms
        progress: '@ '
        result: json
        abort: {run: [sh, stop.sh, '{id}'], grace: 3 s}
        left-behind: leave
        needs-client: 5 s
    far:
      '*': {forward: {to: 'tcp://10.0.0.7:12345', scope: /cob, handler: base, component: wheels, key: own.key_secret, server-key: far.key}}
";

#[test]
fn every_key_is_read() {
    let config = parse(WHOLE).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    assert_eq!((config.listen.port, config.at_once), (Some(12345), 20));
    let configs: Vec<_> = config.scopes[0].configs().collect();
    let [("tts", "say", say), ("far", "*", far)] = configs.as_slice() else {
        panic!("{configs:?}");
    };
    assert_eq!((say.at_once, say.busy), (2, BusyPolicy::Queue(3)));
    assert!(say.kind.needs_fields());
    assert_eq!(say.needs_client, Some(Duration::from_secs(5)));
    let GoalRule::Fields(fields) = &say.description.goal else {
        panic!("{:?}", say.description.goal);
    };
    let [GoalField { default: None, .. }, speed] = fields.as_ref() else {
        panic!("{fields:?}");
    };
    assert_eq!(speed.default, Some("5".into()));
    let program: Program = kind_of(say);
    let run = &program.run;
    assert_eq!(
        (run.directory.to_str(), run.place.as_str()),
        (Some("/tmp"), "robot.yaml:8")
    );
    let environment = [("LANG", "C"), ("EMPTY", ""), ("QUOTED", "")];
    let environment = environment.map(|(name, value)| (name.to_owned(), value.to_owned()));
    assert_eq!(run.environment, environment);
    assert_eq!(
        run.user.as_ref().map(|user| user.name.as_str()),
        Some("root")
    );
    assert_eq!(program.limit, Some(Duration::from_secs(30)));
    assert_eq!((program.output, program.result), (4096, ResultKind::Json));
    assert_eq!(program.rejected_by, [2, 64]);
    assert_eq!(program.decide, Duration::from_millis(500));
    assert_eq!(program.marker.as_deref(), Some("@ "));
    assert!(!program.kills_left_behind);
    let Abort {
        allowed: true,
        by: AbortBy::Program(stop),
        grace,
    } = &program.abort
    else {
        panic!("{:?}", program.abort);
    };
    assert_eq!((stop.arguments.len(), *grace), (3, Duration::from_secs(3)));
    let forward: Forward = kind_of(far);
    assert_eq!(forward.handler.as_deref(), Some("base"));
    assert_eq!(forward.component.as_deref(), Some("wheels"));
    assert_eq!(
        forward.keys,
        Some(ztl_std::keys::KeyFiles {
            own: "/own.key_secret".into(),
            server: "/far.key".into()
        })
    );
}

#[test]
fn short_forms_have_the_default_settings() {
    let program = program_of("[sh, -c, '{goal}']");
    assert!(program.run.arguments[2].guarded);
    assert_eq!((program.limit, program.output), (None, 64 * 1024));
    assert_eq!(program.abort.grace, Duration::from_secs(2));
    assert!(matches!(program.abort.by, AbortBy::Signal("TERM", _)));
    assert!(matches!(
        program_of("{run: [sh], abort: SIGINT}").abort.by,
        AbortBy::Signal("INT", _)
    ));
    assert!(!program_of("{run: [sh], abort: no}").abort.allowed);
    assert_eq!(kind_of::<BuiltIn>(&component_of("echo")), BuiltIn::Echo);
    let sleep = component_of("{built-in: sleep, at-once: 3}");
    assert_eq!(sleep.at_once, 3);
    assert_eq!(sleep.description.goal.to_string(), "a number of at least 0");
    assert_eq!(
        component_of("{run: [sh], goal: number}")
            .description
            .goal
            .to_string(),
        "a number"
    );
    let bounds = "{run: [sh], goal: {least: 0, most: 1.5}}";
    assert_eq!(
        component_of(bounds).description.goal.to_string(),
        "a number from 0 to 1.5"
    );
    let words = "{run: [sh], goal: {one-of: [left, right]}}";
    assert_eq!(
        component_of(words).description.goal.to_string(),
        "left or right"
    );
}

#[test]
fn arguments_that_a_client_may_begin_with_a_dash_are_guarded() {
    let guarded = |text: &str| {
        program_of(text)
            .run
            .arguments
            .last()
            .map(|last| last.guarded)
    };
    assert_eq!(guarded("{run: [sh, '{goal}']}"), Some(true));
    assert_eq!(
        guarded("{run: [sh, '{goal}'], dashes: allowed}"),
        Some(false)
    );
    assert_eq!(guarded("{run: [sh, '{goal}'], goal: number}"), Some(false));
    assert_eq!(
        guarded("{run: [sh, '{goal.x}'], goal: {fields: {x: number}}}"),
        Some(false)
    );
    assert_eq!(
        guarded("{run: [sh, '{goal.x}'], goal: {fields: {x: text}}}"),
        Some(true)
    );
    assert_eq!(guarded("{run: [sh, 'x{goal}']}"), Some(false));
    assert_eq!(guarded("{run: [sh, '{component}']}"), Some(false));
    let wild = parse("scopes: {/r: {h: {'*': [sh, '{component}']}}}").expect("it is right");
    let component = wild.scopes[0].configs().next().expect("a component").2;
    let program: Program = kind_of(component);
    assert!(program.run.arguments[1].guarded);
}

#[test]
fn each_mistake_is_shown_with_its_place_and_a_remedy() {
    let text = "\
prot: 1
scopes:
  a;b: {h: {c: echo}}
  /r:
    h:
      one: {rnu: [sh]}
      two: {run: [sh, '{gaol}'], limit: soon, at_once: 2}
      three: {run: ['{goal}']}
      four: {shell: 'echo {goal}'}
      five: {run: [sh], shell: x, abort: {signal: IMT}}
      six: {run: [sh, '{goal.y}'], goal: {fields: {x: number}}}
      seven: {run: [sh], goal: {least: 2, most: 1}}
      eight: {run: [sh], goal: {type: numbre}, busy: queue}
      nine: {run: [sh], user: nobody-is-called-so, rejected-by: 0}
      ten: ehco
      eleven: {forward: {to: 10.0.0.7, scope: /cob, key: a}}
      twelve: {run: [sh], output: 2 GiB, decide: 1 s}
      thirteen: {run: [sh], abort: no, busy: replace}
      fourteen: {run: [sh], abort: no, needs-client: 5 s}
      fifteen: {built-in: sleep, needs-client: 1 s}
      sixteen: {goal: number}
      'a:b': echo
";
    let mistakes = parse(text).expect_err("mistakes").to_string();
    let first = mistakes
        .lines()
        .filter(|line| line.starts_with("robot.yaml:"));
    let first: Vec<&str> = first.collect();
    let expected = [
        "robot.yaml:1:1: unknown key 'prot'; did you mean 'port'?",
        "robot.yaml:3:3: the scope 'a;b' contains ';', so no client can reach it; write it as /lab",
        "robot.yaml:6:13: unknown key 'rnu'; did you mean 'run'?",
        "robot.yaml:7:23: unknown placeholder '{gaol}'; did you mean '{goal}'?",
        "robot.yaml:7:41: 'soon' is not a time, as 30 s, 300 ms or 5 min",
        "robot.yaml:7:47: unknown key 'at_once'; did you mean 'at-once'?",
        "robot.yaml:8:21: no client may choose the program; use an argument",
        "robot.yaml:9:21: a shell would execute what '{goal}' stands for; write \"$ZTL_GOAL\", or use run",
        "robot.yaml:10:32: give only one of: run, shell, built-in, forward, ros1-action, ros1-trajectory, ros1-publish, ros1-service, ros1-parameter, naoqi, naoqi-wait, http",
        "robot.yaml:10:51: 'IMT' is not known here; did you mean 'INT'?",
        "robot.yaml:11:23: no goal has 'y': it is {x: a number}",
        "robot.yaml:12:32: least 2 is greater than most 1",
        "robot.yaml:13:39: 'numbre' is not known here; did you mean 'number'?",
        "robot.yaml:13:54: 'queue' is not refuse, replace, or queue with how many may wait, as queue 3",
        "robot.yaml:14:31: there is no user 'nobody-is-called-so' on this machine",
        "robot.yaml:14:65: '0' is not an exit code from 1 to 255, or a list of them",
        "robot.yaml:15:12: 'ehco' is not known here; did you mean 'echo'?",
        "robot.yaml:16:30: '10.0.0.7' is not an address, as tcp://10.0.0.7:12345",
        "robot.yaml:16:58: an encrypted connection needs both: key: robot.key_secret, server-key: far.key",
        "robot.yaml:17:35: '2 GiB' is not a size from 1 byte to 1000 KiB, as 64 KiB",
        "robot.yaml:17:50: decide needs exit codes that reject: rejected-by: [2]",
        "robot.yaml:18:46: busy: replace aborts tasks; remove abort: no",
        "robot.yaml:19:54: needs-client aborts tasks; remove abort: no",
        "robot.yaml:20:48: this must be at least 2s: a client that waits asks every second; better 5s",
        "robot.yaml:21:16: nothing does this task; write run: [PROGRAM, ARGUMENT]",
        "robot.yaml:22:7: invalid name 'a:b' for a component: expected no ':' and no control characters",
    ];
    assert_eq!(first, expected, "{mistakes}");
    let none = parse("port: 1").expect_err("no scopes").to_string();
    assert!(
        none.contains("'scopes' is missing; write scopes: {/robot:"),
        "{none}"
    );
}

#[test]
fn a_kind_without_its_value_is_not_taken_for_another_kind() {
    for (kind, remedy) in [
        ("ros1-publish", "write its value after 'ros1-publish:'"),
        ("run", "write run: [PROGRAM, ARGUMENT]"),
    ] {
        let text = format!("scopes: {{/r: {{h: {{c: {{{kind}: }}}}}}}}");
        let mistakes = parse(&text).expect_err("no value").to_string();
        let wanted = format!("'{kind}' has no value; {remedy}");
        assert!(mistakes.contains(&wanted), "{mistakes}");
    }
}

#[test]
fn streams_are_read() {
    let text = "\
publish: 2
streams:
  /robot:
    microphone: {run: [sh, '{x: 1}'], frame: 3200 bytes, when-watched: 5 s}
    battery: {shell: 'echo {id}', frame: line, latest: true, longest: 64 KiB, directory: /tmp, environment: {A: b}, user: root, abort: {signal: INT, grace: 1 s}}
    arm/left: {run: [sh], frame: jpeg, rate: 2.5 Hz, abort: {run: [sh, stop.sh]}}
  /other: {pose: {run: [sh], frame: json}, raw: {run: [sh], frame: length}}
";
    let mut config = parse(text).unwrap_or_else(|mistakes| panic!("{mistakes}"));
    assert_eq!(config.streams(), [("/robot", 3), ("/other", 2)]);
    assert_eq!(config.scope_names(), ["/robot", "/other"]);
    assert!(config.unpublished.is_none());
    let [microphone, battery, arm, pose, raw] = config.streams.as_slice() else {
        panic!("{config:?}");
    };
    assert_eq!(microphone.topic(), "/robot/microphone");
    assert_eq!(microphone.framing, Framing::Fixed(3200));
    assert_eq!(microphone.when_watched, Some(Duration::from_secs(5)));
    assert_eq!((microphone.latest, microphone.interval), (false, None));
    assert_eq!(stream_program(microphone).result, ResultKind::Stream);
    assert_eq!((battery.framing, battery.latest), (Framing::Line, true));
    assert_eq!((battery.longest, battery.when_watched), (64 * 1024, None));
    let run = &stream_program(battery).run;
    assert_eq!(run.directory.to_str(), Some("/tmp"));
    assert_eq!(run.environment, [("A".to_owned(), "b".to_owned())]);
    assert!(run.user.is_some());
    assert!(matches!(
        stream_program(battery).abort.by,
        AbortBy::Signal("INT", _)
    ));
    assert_eq!((arm.framing, arm.longest), (Framing::Jpeg, 4 << 20));
    assert_eq!(arm.topic(), "/robot/arm/left");
    assert_eq!(arm.interval, Some(Duration::from_millis(400)));
    assert!(matches!(stream_program(arm).abort.by, AbortBy::Program(_)));
    assert_eq!(
        (pose.framing, raw.framing),
        (Framing::Json, Framing::Length)
    );
    for name in ["/", "/lab/", "/lab/$tasks"] {
        let mistake = config.rename_scopes(name).expect_err(name);
        assert!(mistake.contains("cannot have streams"), "{mistake}");
    }
    config.rename_scopes("/lab").expect("a scope");
    assert_eq!(config.streams(), [("/lab", 5)]);
}

#[test]
fn each_mistake_in_a_stream_is_shown_with_its_place_and_a_remedy() {
    let text = "\
publish: 2
streams:
  a;b: {x: {run: [sh], frame: line}}
  /none: {}
  /r:
    /one: {run: [sh], frame: line}
    $two: {run: [sh], frame: line}
    three: {run: [sh], frame: jpg, latests: true}
    four: {run: [sh]}
    five: {frame: line}
    six: {run: [sh], shell: x, frame: 0 bytes}
    seven: {run: [sh], frame: 3200, rate: 10, when-watched: 0 s}
    eight: {run: [sh], frame: 2 bytes, longest: 1 KiB, latest: maybe}
    nine: {run: [sh, '{goal}'], frame: line, longest: 17 MiB, rate: 0 Hz}
    ten: {run: [sh], frame: line, abort: no, dashes: allowed}
    eleven: {run: [sh], frame: line, abort: {signal: IMT}, user: nobody-is-called-so}
    twelve: [sh]
    thirteen: {run: [], frame: line, environment: {'a=b': c}, rate: -1 Hz}
    a/$tasks: {run: [sh], frame: line, when-watched: 999 ms}
    a//b: {run: [sh], frame: line}
    a/b: {run: [sh], frame: line}
  /r/a: {b: {run: [sh], frame: line}, c: {run: [sh], frame: line}}
  /: {x: {run: [sh], frame: line}}
  /r/: {x: {run: [sh], frame: line}}
  /r/$tasks/1: {x: {run: [sh], frame: line}}
  $r: {x: {run: [sh], frame: line}}
";
    let mistakes = parse(text).expect_err("mistakes").to_string();
    let places = mistakes
        .lines()
        .filter(|line| line.starts_with("robot.yaml:"));
    let expected = [
        "robot.yaml:3:3: the scope 'a;b' contains ';', so no client can reach it; write it as /lab",
        "robot.yaml:4:10: this is empty; expected its streams",
        "robot.yaml:6:5: invalid name '/one' for a stream; write it as microphone or arm/left",
        "robot.yaml:7:5: invalid name '$two' for a stream; write it as microphone or arm/left",
        "robot.yaml:8:31: 'jpg' is not known here; did you mean 'jpeg'?",
        "robot.yaml:8:36: unknown key 'latests'; did you mean 'latest'?",
        "robot.yaml:9:11: 'frame' is missing; write frame: line",
        "robot.yaml:10:11: nothing writes this stream; write run: [PROGRAM, ARGUMENT]",
        "robot.yaml:11:29: give only one of: run, shell",
        "robot.yaml:11:39: '0 bytes' is not a size from 1 byte to 16 MiB, as 3200 bytes",
        "robot.yaml:12:31: '3200' is not a size from 1 byte to 16 MiB, as 3200 bytes",
        "robot.yaml:12:43: '10' is not a rate from 0.001 Hz to 1000 Hz, as 10 Hz",
        "robot.yaml:12:61: this must be greater than zero",
        "robot.yaml:13:49: each frame has the same length; leave this out",
        "robot.yaml:13:64: 'maybe' is neither true nor false",
        "robot.yaml:14:22: a stream has no task, so nothing stands for '{goal}'",
        "robot.yaml:14:55: '17 MiB' is not a size from 1 byte to 16 MiB, as 3200 bytes",
        "robot.yaml:14:69: '0 Hz' is not a rate from 0.001 Hz to 1000 Hz, as 10 Hz",
        "robot.yaml:15:42: no client can abort a stream; leave this out",
        "robot.yaml:15:46: unknown key 'dashes'; there are: ros1-topic, naoqi-event, naoqi-signal, http-event, frame, longest, latest, rate, when-watched, run, shell, directory, environment, user, abort",
        "robot.yaml:16:54: 'IMT' is not known here; did you mean 'INT'?",
        "robot.yaml:16:66: there is no user 'nobody-is-called-so' on this machine",
        "robot.yaml:17:13: found a list; expected a mapping: run: [PROGRAM, ARGUMENT], frame: line",
        "robot.yaml:18:21: there is no program in this list",
        "robot.yaml:18:52: invalid name 'a=b' for a variable",
        "robot.yaml:18:69: '-1 Hz' is not a rate from 0.001 Hz to 1000 Hz, as 10 Hz",
        "robot.yaml:19:5: invalid name 'a/$tasks' for a stream; write it as microphone or arm/left",
        "robot.yaml:19:54: this must be at least 1s: subscribers that come and go would start the program too often",
        "robot.yaml:20:5: invalid name 'a//b' for a stream; write it as microphone or arm/left",
        "robot.yaml:22:10: the stream at robot.yaml:21:5 has the same topic, /r/a/b; rename one of them",
        "robot.yaml:23:3: the scope '/' contains an empty part, so it cannot have streams; write it as /lab",
        "robot.yaml:24:3: the scope '/r/' contains an empty part, so it cannot have streams; write it as /lab",
        "robot.yaml:25:3: the scope '/r/$tasks/1' contains a part that begins with '$', as only the server's own topics do, so it cannot have streams; write it as /lab",
        "robot.yaml:26:3: the scope '$r' contains a part that begins with '$', as only the server's own topics do, so it cannot have streams; write it as /lab",
    ];
    let places: Vec<&str> = places.collect();
    assert_eq!(places, expected, "{mistakes}");
    let unpublished = parse("streams: {/r: {x: {run: [sh], frame: line}}}");
    let mistake = unpublished.expect("it may be an option").unpublished;
    let said = "robot.yaml:1:10: streams need a port where they are published; write publish: 12346, or give --publish\n";
    let mistake = mistake.expect("a mistake").to_string();
    assert!(mistake.starts_with(said), "{mistake}");
}

#[test]
fn a_forward_without_its_keys_is_not_plain_text() {
    for (keys, message) in [
        (
            "key: a, server_key: b",
            "unknown key 'server_key'; did you mean 'server-key'?",
        ),
        (
            "keys: a, sever-key: b",
            "unknown key 'keys'; did you mean 'key'?",
        ),
        ("server-key: b", "an encrypted connection needs both"),
        (
            "key: ~, server-key: ~",
            "found nothing; expected a file of `ztl keys`",
        ),
    ] {
        let forward = format!("{{forward: {{to: 'tcp://h:1', scope: /cob, {keys}}}}}");
        let text = format!("scopes: {{/r: {{h: {{c: {forward}}}}}}}");
        let mistakes = parse(&text).expect_err(keys).to_string();
        assert!(mistakes.contains(message), "{keys}: {mistakes}");
    }
}

/// The mistakes in a rule for goals.
#[track_caller]
fn mistakes_of(goal: &str) -> Vec<String> {
    let text = format!("scopes: {{/r: {{h: {{c: {{run: [sh], goal: {goal}}}}}}}}}");
    let mistakes = parse(&text).expect_err("a mistake").to_string();
    let first = mistakes.lines().filter_map(|line| {
        let message = line.strip_prefix("robot.yaml:1:")?.split_once(": ")?.1;
        Some(message.to_owned())
    });
    first.collect()
}

#[test]
fn a_key_without_effect_on_goals_is_a_mistake() {
    for (goal, mistakes) in [
        (
            "{type: text, least: 5}",
            &["least has an effect only with type: number"][..],
        ),
        (
            "{type: any, least: -180, most: 180}",
            &[
                "least has an effect only with type: number",
                "most has an effect only with type: number",
            ],
        ),
        (
            "{longest: 18446744073709551615}",
            &[
                "'18446744073709551615' is not a number of characters up to 1048576, the most that a message has",
            ],
        ),
        (
            "{longest: 99999999999999999999}",
            &[
                "'99999999999999999999' is not a number of characters up to 1048576, the most that a message has",
            ],
        ),
        (
            "{type: whole, longest: 3}",
            &["longest has an effect only with type: text"],
        ),
        (
            "{type: number, one-of: [1, 2]}",
            &["type has no effect beside one-of; remove it"],
        ),
        (
            "{most: 2, fields: {x: number}}",
            &["most has no effect beside fields; remove it"],
        ),
        (
            "{one-of: [a], fields: {x: number}}",
            &["give only one of one-of and fields"],
        ),
        (
            "{type: text, unit: mm}",
            &["unit has an effect only with type: number"],
        ),
        (
            "{list-of: number, fields: {x: number}}",
            &["give only one of fields and list-of"],
        ),
        ("{step: 0}", &["a step must be greater than zero"]),
        ("{one-of: []}", &["there is no word in this list"]),
        (
            "{type: number, default: 3}",
            &["only fields have a default"],
        ),
    ] {
        assert_eq!(mistakes_of(goal), mistakes, "{goal}");
    }
}

#[test]
fn a_file_without_components_is_a_mistake() {
    for (text, wanted) in [
        ("scopes: {}", "scopes, as /robot"),
        ("scopes: {/r: {}}", "its handlers"),
        ("scopes: {/r: {h: {}}}", "the handler's components"),
    ] {
        let mistakes = parse(text).expect_err("a mistake").to_string();
        let message = format!("this is empty; expected {wanted}\n");
        assert!(mistakes.contains(&message), "{mistakes}");
    }
}

#[test]
fn a_goal_in_a_shells_command_is_a_warning() {
    let warnings = |component: &str| {
        let config = parse(&format!("scopes: {{/r: {{h: {{c: {component}}}}}}}"));
        config.expect("it is right").warnings.len()
    };
    assert_eq!(warnings("[sh, -c, 'say {goal}']"), 1);
    assert_eq!(warnings("[/bin/sh, -e, -c, 'say {goal}']"), 1);
    assert_eq!(warnings("[sh, -c, 'say \"$0\"', '{goal}']"), 0);
    assert_eq!(warnings("[sh, say, '{goal}']"), 0);
    assert_eq!(warnings("{run: [sh, -c, 'turn {goal}'], goal: number}"), 0);
    assert_eq!(warnings("{run: [sh, -c, 'task {id}']}"), 0);
}

#[test]
fn missing_programs_and_directories_are_warnings() {
    let config = parse("scopes: {/r: {h: {c: {run: [./no/such, x], directory: /no/such}}}}");
    let warnings = config.expect("it is right").warnings;
    let said: Vec<&str> = warnings
        .iter()
        .map(|warning| warning.message.as_str())
        .collect();
    let expected = [
        "warning: there is no directory /no/such",
        "warning: /./no/such does not exist; install it or correct the path",
    ];
    assert_eq!(said, expected);
}

#[test]
fn no_file_makes_the_reader_panic() {
    let mut numbers = Garbage::new(0x2545_f491_4f6c_dd1d);
    for _ in 0..3_000 {
        let bytes = numbers.spoil(WHOLE);
        if let Ok(document) = Document::parse("f", &bytes) {
            let _ = Config::read(&document, Path::new("")).map_err(|m| m.to_string());
        }
    }
}
