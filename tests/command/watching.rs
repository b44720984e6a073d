//! `ztl devices`, `ztl ps` and `ztl abort`: list and abort the tasks of a server, whichever client started them.

use ztl_std::{RemoteTask, State};
use ztl_tests::lab::{
    Ended, FakeServer, PATIENCE, Process, SCOPE, Scratch, Server, example, ours_named,
    reserve_port, run_python, until, ztl,
};

/// `ztl` with these arguments and the server's port.
#[track_caller]
fn ask(server: &Server, line: &str) -> Ended {
    let port = server.port.to_string();
    Process::run(ztl().args(line.split(' ')).args(["-p", &port]))
}

/// The same, which must succeed; returns its output.
#[track_caller]
fn tell(server: &Server, line: &str) -> String {
    let ended = ask(server, line);
    assert_eq!(
        (ended.code, ended.stderr.as_str()),
        (Some(0), ""),
        "{line}: {ended:?}"
    );
    ended.stdout
}

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
}

fn client(server: &Server) -> RemoteTask {
    let remote = RemoteTask::connect(&server.endpoint(), SCOPE).expect("an address");
    remote.with_timeout(PATIENCE)
}

#[test]
fn devices_lists_connected_and_missing_devices() {
    let nobody = format!("ghost=tcp:127.0.0.1:{}", reserve_port());
    let gateway = Server::gateway(&["gripper=sim:gripper", "head=sim:head", &nobody]);
    gateway.wait_ready("gripper");
    gateway.wait_ready("head");
    gateway.process.wait_for("Device 'ghost'");
    gateway.wait_described(&["opens the finger", "turns the head"]);

    let text = tell(&gateway, "devices");
    for part in [
        "/test gripper at sim:gripper: ready\n",
        "finger: 0 to 100 percent; opens the finger; a second task is refused; without link it goes to its safe state, also when idle\n",
        "pan: -90 to 90 degrees, left, straight, right; turns the head;",
        "ghost at tcp:127.0.0.1:",
        "not ready: ",
        "refused",
    ] {
        assert!(text.contains(part), "'{part}' in {text}");
    }

    let told = json(&tell(&gateway, "devices --json"));
    let gripper = &told["/test"]["gripper"];
    assert_eq!(gripper["ready"], true);
    assert_eq!(gripper["firmware"]["name"], "gripper");
    assert_eq!(gripper["components"][0]["range"], json("[0.0, 100.0]"));
    assert_eq!(gripper["link"]["sessions"], 1);
    assert!(
        gripper["link"]["round_trip_p50_us"].as_u64() > Some(0),
        "{told}"
    );
    assert_eq!(told["/test"]["ghost"]["ready"], false);
    assert_eq!(told["/test"]["ghost"]["firmware"], serde_json::Value::Null);

    let one = tell(&gateway, "devices head");
    assert!(one.contains("pan") && !one.contains("finger"), "{one}");
    let one = json(&tell(&gateway, "devices ghost --json"));
    assert_eq!(
        one,
        json(&format!(
            r#"{{"/test": {{"ghost": {}}}}}"#,
            one["/test"]["ghost"]
        ))
    );
    assert_eq!(one["/test"]["ghost"]["ready"], false);
    let one = tell(&gateway, "devices head --yaml");
    assert!(one.contains("pan") && !one.contains("finger"), "{one}");
    for line in ["devices tail", "devices tail --json", "devices tail --yaml"] {
        let ended = ask(&gateway, line);
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(1), ""), "{line}");
        assert_eq!(
            ended.stderr, "ztl: no device 'tail'; there are: ghost, gripper, head\n",
            "{line}"
        );
    }
}

#[test]
fn a_device_in_json_is_chosen_in_every_scope_and_keeps_what_this_version_does_not_know() {
    let server = FakeServer::with_questions(|request| {
        let answer = match request.ends_with(";devices") {
            true => r#"{"/a": {"x": {"new": [1]}, "y": {}}, "/b": {"y": {}}, "/c": {"x": 2}}"#,
            false => "{ztl: 1, version: '9', boot: 7, scopes: {}}",
        };
        format!("$ztl;5;0;{answer}").into_bytes()
    });
    let port = server.port.to_string();
    let told = |words: &[&str]| Process::run(ztl().args(["devices", "-p", &port]).args(words));
    let one = told(&["--json", "x"]);
    assert_eq!(
        json(&one.stdout),
        json(r#"{"/a": {"x": {"new": [1]}}, "/c": {"x": 2}}"#),
        "{one:?}"
    );
    let one = told(&["--yaml", "x"]);
    assert_eq!(
        one.stdout, "/a:\n  x:\n    new:\n    - 1\n/c:\n  x: 2\n",
        "{one:?}"
    );
}

#[test]
fn another_clients_task_is_listed_and_aborted() {
    let gateway = Server::simulated();
    assert_eq!(tell(&gateway, "ps"), "No task is running.\n");
    assert_eq!(tell(&gateway, "abort --all"), "No task is running.\n");

    // It takes 20 s then, so it still runs when it is aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    let mut other = client(&gateway);
    let task = other.trigger("gripper", "finger", "100").expect("accepted");
    let listed = tell(&gateway, "ps");
    let row = format!("{}  /test  gripper:finger:100  ACCEPTED  ", task.id);
    assert!(
        listed.lines().any(|line| line.starts_with(&row)),
        "{listed}"
    );
    let device = tell(&gateway, "devices gripper");
    let line = format!("  task {} gripper:finger:100: ACCEPTED since ", task.id);
    assert!(device.contains(&line), "{device}");

    let said = tell(&gateway, &format!("abort {}", task.id));
    let start = format!("{} gripper:finger:100: ABORTED, ", task.id);
    assert!(said.starts_with(&start), "{said}");
    let end = other.status(&task.id).expect("an answer");
    assert_eq!(end.state, State::Aborted);
    // The text is the device's own: where the finger stopped.
    assert_eq!(said, format!("{start}{}\n", end.text));

    assert_eq!(tell(&gateway, "ps"), "No task is running.\n");
    let told = json(&tell(&gateway, "ps --all --json"));
    assert_eq!(told["tasks"][0]["id"].to_string(), task.id.as_str());
    assert_eq!(told["tasks"][0]["state"], 4);
    // Its times pass.
    until("it has grown older since its end", PATIENCE, || {
        let told = json(&tell(&gateway, "ps --all --json"));
        let [age, ended] = ["age_ms", "ended_ms"].map(|name| told["tasks"][0][name].as_u64());
        (age > ended && ended > Some(0)).then_some(())
    });
}

#[test]
fn abort_all_stops_every_task() {
    let gateway = Server::simulated();
    // They take 20 s and 10 s then, so both still run when they are aborted.
    gateway.set_speed("gripper", "speed", 0.1);
    gateway.set_speed("head", "speed", 0.1);
    let mut other = client(&gateway);
    let finger = other.trigger("gripper", "finger", "100").expect("accepted");
    let pan = other.trigger("head", "pan", "left").expect("accepted");
    let said = tell(&gateway, "abort --all");
    assert_eq!(said.matches(": ABORTED, ").count(), 2, "{said}");
    for id in [finger.id, pan.id] {
        assert_eq!(other.status(id).expect("an answer").state, State::Aborted);
    }
}

#[test]
fn aborting_an_unknown_task_fails() {
    let gateway = Server::simulated();
    let ended = ask(&gateway, "abort 7");
    assert_eq!(ended.code, Some(1));
    assert!(
        ended.stderr.starts_with("ztl: no task 7 is known at "),
        "{ended:?}"
    );
    let ended = ask(&gateway, "abort 0");
    assert_eq!(ended.code, Some(2));
    assert!(
        ended.stderr.contains("an id is a whole number above 0"),
        "{ended:?}"
    );
}

#[test]
fn an_unknown_id_fails_and_the_other_tasks_are_aborted() {
    let naps = Server::naps();
    for server in [
        Server::original(),
        Server::simple_original(),
        Server::ours(),
    ] {
        let ended = ask(&server, "abort -s /test 2");
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(
            ended.stderr.starts_with("ztl: no task 2 is known at "),
            "{ended:?}"
        );
        // Advice that cannot work there would cost time.
        let lists_tasks = ask(&server, "ps").code == Some(0);
        assert_eq!(
            ended.stderr.contains("ztl ps --all"),
            lists_tasks,
            "{ended:?}"
        );
        let ended = ask(&server, "abort -s /nowhere 2");
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert_eq!(ended.stdout, "2: the server has no scope '/nowhere'\n");
    }
    let mut other = client(&naps);
    let task = other.trigger("nap", "for", "600").expect("accepted");
    for scope in ["", "-s /test "] {
        let ended = ask(&naps, &format!("abort {scope}7 {}", task.id));
        assert_eq!(ended.code, Some(1), "{ended:?}");
        assert!(
            ended.stderr.starts_with("ztl: no task 7 is known at "),
            "{ended:?}"
        );
        assert!(ended.stdout.contains(": ABORTED, "), "{ended:?}");
    }
    assert_eq!(
        other.status(task.id).expect("an answer").state,
        State::Aborted
    );
}

#[test]
fn a_server_is_named_by_the_configuration_file_or_the_environment() {
    let gateway = Server::simulated();
    let port = gateway.port.to_string();
    let nobody = reserve_port().to_string();
    let scratch = Scratch::new();
    let file = scratch.path("zmq-remotes.yaml");
    let text = format!(
        "remotes:\n  lab: {{host: localhost, port: {port}, scope: /test}}\n  \
         gone: {{host: localhost, port: {nobody}, scope: /test}}\n"
    );
    std::fs::write(&file, text).expect("a file");
    let config = file.display().to_string();
    let run = |line: &str, environment: &[(&str, &str)]| {
        let mut command = ztl();
        for name in ["ZTL_HOST", "ZTL_PORT", "ZTL_SCOPE", "XDG_CONFIG_HOME"] {
            command.env_remove(name);
        }
        command.env("HOME", scratch.path("home"));
        command.envs(environment.iter().copied());
        let words = line.split(' ').map(|word| match word {
            "CONFIG" => config.as_str(),
            word => word,
        });
        Process::run(command.args(words))
    };
    let usual = [("XDG_CONFIG_HOME", scratch.path("").display().to_string())];
    let usual = usual
        .each_ref()
        .map(|(name, value)| (*name, value.as_str()));
    let variables = [
        ("ZTL_HOST", "localhost"),
        ("ZTL_PORT", port.as_str()),
        ("ZTL_SCOPE", SCOPE),
    ];
    for (command, said) in [
        ("ps", "No task is running."),
        ("describe", "gripper"),
        ("abort --all", "No task is running."),
        ("devices", "/test gripper at sim:gripper: ready"),
        ("doctor", "round trip"),
        ("task-client --exit-status gripper:finger:10", "COMPLETED"),
    ] {
        for (options, environment) in [
            (" -r lab -c CONFIG", &[][..]),
            (" --remote lab --config CONFIG", &[]),
            (" -r lab", &usual),
            ("", &variables),
            // An explicit option wins.
            (
                " -r lab -c CONFIG",
                &[("ZTL_PORT", nobody.as_str()), ("ZTL_SCOPE", "/x")],
            ),
        ] {
            let ended = run(&format!("{command}{options}"), environment);
            // The doctor checks this machine, too.
            let fine = ended.code == Some(0) || command == "doctor";
            assert!(
                fine && ended.stdout.contains(said),
                "{command}{options}: {ended:?}"
            );
        }
        let option = format!("{command} -p {nobody}");
        let ended = run(&option, &variables);
        assert_ne!(ended.code, Some(0), "{option}: {ended:?}");

        for (options, environment, wrong) in [
            (" -r labb -c CONFIG", &[][..], "did you mean 'lab'?"),
            (" -r lab -c /no/such/file", &[], "/no/such/file: "),
            (" -r lab", &[], "no port for host 'lab'"),
            (
                "",
                &[("ZTL_PORT", "http")],
                "invalid ZTL_PORT 'http': expected 0 to 65535",
            ),
            (
                "",
                &[("ZTL_PORT", "70000")],
                "invalid ZTL_PORT '70000': expected 0 to 65535",
            ),
            ("", &[("ZTL_HOST", "localhost")], "no port: "),
        ] {
            let ended = run(&format!("{command}{options}"), environment);
            assert_eq!(ended.code, Some(2), "{command}{options}: {ended:?}");
            assert!(
                ended.stderr.contains(wrong),
                "{command}{options}: {ended:?}"
            );
            assert_eq!(ended.stdout, "", "{command}{options}");
        }
        if command != "doctor" {
            let ended = run(command, &[]);
            assert_eq!(ended.code, Some(2), "{ended:?}");
            assert!(ended.stderr.contains("no port: give --port"), "{ended:?}");
        }
    }
    let ended = run("task-client -r localhost a:b:c", &variables[1..2]);
    assert_eq!(ended.code, Some(2), "{ended:?}");
    assert!(ended.stderr.contains("no scope: give --scope"), "{ended:?}");

    // Under the original's name it is the original's client, which lacks this feature.
    let mut original = ours_named(&scratch, "ztl_task_client");
    original.envs(variables).envs(usual);
    let ended = Process::run(original.arg("gripper:finger:10"));
    assert_eq!(ended.code, Some(2), "{ended:?}");
    let missing = ended.stderr.lines().last().unwrap_or_default();
    for option in ["--remote <REMOTE>", "--port <PORT>", "--scope <SCOPE>"] {
        assert!(missing.contains(option), "{option}: {ended:?}");
    }
}

#[test]
fn a_scope_of_the_environment_does_not_narrow_what_abort_all_stops() {
    let naps = Server::naps();
    let mut other = client(&naps);
    let task = other.trigger("nap", "for", "600").expect("accepted");
    let port = naps.port.to_string();
    let mut command = ztl();
    command.env("ZTL_SCOPE", "/elsewhere").env("ZTL_PORT", port);
    let ended = Process::run(command.args(["abort", "--all"]));
    assert_eq!(ended.code, Some(0), "{ended:?}");
    assert_eq!(
        other.status(task.id).expect("an answer").state,
        State::Aborted
    );
}

#[test]
fn each_of_our_servers_describes_its_components() {
    let scratch = Scratch::new();
    let file = scratch.path("robot.yaml");
    let text = "port: 0\nscopes:\n  /robot:\n    tts: {say: echo, hush: echo}\n    \"*\": {stop: sleep}\n  /lamp:\n    led: {\"*\": echo}\n";
    std::fs::write(&file, text).expect("a file");
    let serve = Server::start(ztl().arg("serve").arg(&file));
    let (gateway, tests, simple) = (Server::simulated(), Server::ours(), Server::simple_ours());
    gateway.wait_described(&["opens the finger", "turns the head"]);
    for (port, text, scopes) in [
        (
            gateway.port,
            "/test\n  gripper  finger\n  head     pan\n    gripper:finger  a number from 0 to 100 percent  opens the finger; returns its opening in percent\n    head:pan        anything                        turns the head; for example left or straight or right or 45; returns its angle in degrees\n",
            json(r#"{"/test": {"gripper": ["finger"], "head": ["pan"]}}"#),
        ),
        (
            tests.port,
            "/test\n  test  echo, print, sleep\n",
            json(r#"{"/test": {"test": ["echo", "print", "sleep"]}}"#),
        ),
        (
            simple.port,
            "/test\n  its handlers are not told\n",
            json(r#"{"/test": {}}"#),
        ),
        (
            serve.port,
            "/lamp\n  led  *\n/robot\n  *    stop\n  tts  hush, say\n    *:stop  a number of at least 0\n",
            json(r#"{"/robot": {"tts": ["hush", "say"], "*": ["stop"]}, "/lamp": {"led": ["*"]}}"#),
        ),
    ] {
        let port = port.to_string();
        let run = |words: &[&str]| Process::run(ztl().args(words).args(["-p", &port]));
        let told = run(&["describe"]);
        let version = env!("CARGO_PKG_VERSION");
        let head = format!("ztl {version} at tcp://localhost:{port}\n");
        let expected = format!("{head}{text}No task is running.\n");
        assert_eq!((told.code, told.stdout), (Some(0), expected));
        let told = json(&run(&["describe", "--json"]).stdout);
        assert_eq!(told["scopes"], scopes, "{told}");
        assert_eq!(told["version"], version);
        let listed = run(&["ps"]);
        assert_eq!(listed.stdout, "No task is running.\n", "{listed:?}");
    }
    let mut other = client(&tests);
    let task = other.trigger("test", "sleep", "600").expect("accepted");
    let told = tell(&tests, "describe");
    assert!(
        told.ends_with("1 task is running; `ztl ps` shows it.\n"),
        "{told}"
    );
    let told = json(&tell(&tests, "describe --json"));
    assert_eq!(told["running"][task.id.as_str()], SCOPE, "{told}");
    // PyYAML reads the same.
    let to_json = "import json, sys, yaml; print(json.dumps(yaml.safe_load(sys.stdin)))";
    let yaml = run_python(&["-c", to_json], &tell(&tests, "describe --yaml"));
    assert_eq!(json(&yaml), told);
}

#[test]
fn describe_and_abort_work_on_a_device_that_speaks_zeromq() {
    let device = Process::start(example("zmtp").arg("127.0.0.1:0"));
    let device = Server {
        port: device.wait_for_port("tcp://"),
        process: device,
    };
    let told = tell(&device, "describe");
    assert!(
        told.contains("\n/desk\n  its handlers are not told\n"),
        "{told}"
    );
    assert_eq!(tell(&device, "ps"), "No task is running.\n");
    let other = RemoteTask::connect(&device.endpoint(), "/desk").expect("an address");
    let mut other = other.with_timeout(PATIENCE);
    let mut goals = ["100", "0"].into_iter().cycle();
    // The motion takes a second and may be over before the request.
    let mut start = || {
        let goal = goals.next().expect("one after the other");
        other.trigger("desk", "slide", goal).expect("accepted").id
    };
    until("it is listed", PATIENCE, || {
        let id = start();
        let listed = tell(&device, "ps");
        let as_json = json(&tell(&device, "ps --json"));
        tell(&device, "abort --all");
        let id = id.to_string();
        let row = listed.lines().nth(1).unwrap_or_default();
        let row: Vec<&str> = row.split_whitespace().collect();
        (row == [id.as_str(), "/desk"] && as_json["tasks"][0]["scope"] == "/desk").then_some(())
    });
    until("it is stopped on its way", PATIENCE, || {
        let id = start();
        let said = tell(&device, "abort --all");
        said.starts_with(&format!("{id}: ABORTED, ")).then_some(())
    });
    assert_eq!(tell(&device, "ps"), "No task is running.\n");
}

#[test]
fn the_exit_code_shows_whether_the_task_stopped() {
    let server = Server::ours();
    let mut other = client(&server);
    let task = other.trigger("test", "sleep", "20").expect("accepted");
    let listed = tell(&server, "ps");
    assert!(listed.contains("test:sleep:20"), "{listed}");
    let ended = ask(&server, &format!("abort {}", task.id));
    let stopped = other.status(&task.id).expect("an answer").state == State::Aborted;
    assert_eq!(ended.code, Some(i32::from(!stopped)), "{ended:?}");
}

#[test]
fn the_original_server_is_reported_as_giving_no_description() {
    let server = Server::original();
    for line in [
        "ps",
        "abort --all",
        "abort 5",
        "describe",
        "describe --json",
    ] {
        let ended = ask(&server, line);
        assert_eq!(ended.code, Some(1), "{line}");
        assert!(
            ended
                .stderr
                .contains("is an original ztl; it does not say what it offers"),
            "{line}: {ended:?}"
        );
    }
    let ended = ask(&server, "devices");
    assert!(ended.stderr.contains("it is not a gateway"), "{ended:?}");
    // With an explicit scope, its tasks can be aborted.
    let mut other = client(&server);
    let task = other.trigger("test", "sleep", "1").expect("accepted");
    until("the original's task to run", PATIENCE, || {
        let state = other.status(&task.id).ok()?.state;
        (state == State::Accepted || state.is_final()).then_some(())
    });
    let ended = ask(&server, &format!("abort -s {SCOPE} {}", task.id));
    assert!(
        ended.stdout.starts_with(&format!("{}: ", task.id)),
        "{ended:?}"
    );
}
