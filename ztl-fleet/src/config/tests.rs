use std::sync::atomic::{AtomicU32, Ordering};

use super::*;

fn mistakes(text: &str) -> String {
    mistakes_of("agent", text, |path| AgentConfig::load(path).map(drop))
}

fn mistakes_of(what: &str, text: &str, load: impl Fn(&Path) -> Result<(), Diagnostics>) -> String {
    let directory = std::env::temp_dir();
    // Tests run at the same time.
    static NEXT: AtomicU32 = AtomicU32::new(0);
    let number = NEXT.fetch_add(1, Ordering::Relaxed);
    let name = format!("ztl-fleet-{what}-{}-{number}.yaml", std::process::id());
    let path = directory.join(name);
    std::fs::write(&path, text).unwrap();
    let loaded = load(&path);
    std::fs::remove_file(&path).unwrap();
    let text = loaded.map_or_else(|error| error.to_string(), |_| String::new());
    text.replace(&format!("{}:", path.display()), &format!("{what}.yaml:"))
}

fn of_endpoint(text: &str) -> String {
    mistakes_of("endpoint", text, |path| {
        let config = EndpointConfig::load(path)?;
        config.access.map(drop)
    })
}

#[track_caller]
fn assert_tells(told: &str, message: &str) {
    assert!(told.contains(message), "{message}: {told}");
}

#[test]
fn mistakes_have_their_place() {
    let good = "name: arm-1\nserver: tcp://127.0.0.1:7\nrouters: tcp/10.0.0.1:7447\n";
    assert_eq!(mistakes(good), "");
    let start = "name: a\nserver: tcp://h:7\n";
    for (wrong, message) in [
        (
            "name: arm/1\nserver: tcp://h:7\nrouters: tcp/h:7\n".to_owned(),
            "agent.yaml:1:7: 'arm/1' is not a robot's name",
        ),
        (
            "name: a\nserver: 7\nrouters: tcp/h:7\n".to_owned(),
            "agent.yaml:2:9: '7' is not an endpoint",
        ),
        (
            format!("{start}publish: 12346\nrouters: tcp/h:7\n"),
            "agent.yaml:3:10: '12346' is not an endpoint",
        ),
        (start.to_owned(), "routers: [tcp/10.0.0.1:7447]"),
        (
            format!("{start}routers: []\n"),
            "agent.yaml:3:10: the list is empty; write a router's address, as tcp/10.0.0.1:7447",
        ),
        (
            format!("{start}routers: [udp/h:7]\n"),
            "agent.yaml:3:11: 'udp/h:7' is not a router's address",
        ),
        (
            format!("{start}routers: [tcp/h:0]\n"),
            "agent.yaml:3:11: 'tcp/h:0': port 0 stands for any port",
        ),
        (
            format!("{start}routers: tcp/h:7\nscopes: lab\n"),
            "agent.yaml:4:9: scope 'lab' does not begin with '/'",
        ),
        (
            format!("{start}routers: tls/h:7\ntls: {{ca: no.pem}}\n"),
            "agent.yaml:4:11: cannot read",
        ),
        (
            format!("{start}routers: [tls/h:7, tcp/h:7]\n"),
            "agent.yaml:3:11: tls/h:7 needs certificates; write tls: {ca: ca.pem,",
        ),
        (
            format!("{start}routers: [tls/h:7, tcp/h:7]\ntls: {{ca: no.pem}}\n"),
            "agent.yaml:3:20: tcp/h:7 is not encrypted, although the file has 'tls'; write tls/h:7",
        ),
        // A value that is forgotten does not leave out encryption.
        (
            format!("{start}routers: tcp/h:7\ntls:\n"),
            "agent.yaml:3:10: tcp/h:7 is not encrypted",
        ),
        (
            format!("{start}routers: tcp/h:7\ngruops: x\n"),
            "agent.yaml:4:1: unknown key 'gruops'; did you mean 'groups'?",
        ),
    ] {
        assert_tells(&mistakes(&wrong), message);
    }
}

#[test]
fn a_router_listens_where_others_can_find_it() {
    let of_router =
        |text: &str| mistakes_of("router", text, |path| Links::load_router(path).map(drop));
    for good in [
        "listen: tcp/0.0.0.0:7447\n",
        "listen: ['tcp/[::]:7447']\nrouters: []\n",
    ] {
        assert_eq!(of_router(good), "");
    }
    for (wrong, message) in [
        (
            "listen: []\n",
            "router.yaml:1:9: the list is empty; write where to listen",
        ),
        (
            "listen: tcp/*\n",
            "router.yaml:1:9: 'tcp/*': '*' is not an address; for every address of this machine, write tcp/0.0.0.0:7447",
        ),
        ("listen: tcp/*:7447\n", "write tcp/0.0.0.0:7447"),
        (
            "listen: tcp/0.0.0.0:0\n",
            "router.yaml:1:9: 'tcp/0.0.0.0:0': port 0 stands for any port, and others must know it; write tcp/0.0.0.0:7447",
        ),
        (
            "listen: tcp/0.0.0.0\n",
            "'tcp/0.0.0.0' is not where to listen, as tcp/0.0.0.0:7447",
        ),
        ("listen: 7447\n", "'7447' is not where to listen"),
    ] {
        assert_tells(&of_router(wrong), message);
    }
}

#[test]
fn a_file_for_another_command_is_one_mistake_that_names_the_command() {
    let robot = "name: arm-1\nserver: tcp://127.0.0.1:7\nrouters: tcp/10.0.0.1:7447\n";
    let router = "listen: tcp/0.0.0.0:7447\n";
    let endpoint = "port: 12345\nrouters: tcp/10.0.0.1:7447\n";
    let of_router =
        |text: &str| mistakes_of("router", text, |path| Links::load_router(path).map(drop));
    for (told, message) in [
        (
            of_endpoint(robot),
            "endpoint.yaml:1:1: this is the file of a robot, for `ztl-fleet join`; expected an endpoint",
        ),
        (
            of_endpoint(router),
            "endpoint.yaml:1:1: this is the file of a router, for `ztl-fleet router`",
        ),
        (
            mistakes(router),
            "agent.yaml:1:1: this is the file of a router",
        ),
        (
            mistakes(endpoint),
            "agent.yaml:1:1: this is the file of an endpoint, for `ztl-fleet endpoint`; expected an agent",
        ),
        (
            of_router(robot),
            "router.yaml:1:1: this is the file of a robot",
        ),
        (
            of_router(endpoint),
            "router.yaml:1:1: this is the file of an endpoint",
        ),
    ] {
        assert_tells(&told, message);
        assert_eq!(told.matches(".yaml:").count(), 1, "{told}");
    }
}

#[test]
fn keys_are_needed_on_both_sides_and_for_each_robot() {
    let name = std::env::temp_dir().join(format!("ztl-fleet-desk-{}", std::process::id()));
    let files = KeyPair::generate().write(&name).unwrap();
    let name = name.display();
    let endpoint = |more: &str| of_endpoint(&format!("routers: tcp/h:7\n{more}"));
    let own = format!("fleet-key: {name}.key_secret\n");
    let arm = format!("arm: {{key: {name}.key}}");
    assert_eq!(endpoint(&format!("{own}robots: {{{arm}}}\n")), "");
    let key = format!("key: {name}.key_secret\n");
    let anna = format!("client-keys: [{name}.key, /arm={name}.key, /arm/lab={name}.key]\n");
    assert_eq!(endpoint(&format!("{key}{anna}")), "");
    for (wrong, message) in [
        (
            own.clone(),
            "endpoint.yaml:2:12: with a fleet-key, 'robots' must name each robot",
        ),
        (
            format!("{own}robots: [arm]\n"),
            "endpoint.yaml:3:9: found a list; expected a mapping",
        ),
        (
            format!("{own}robots: {{arm: {{}}}}\n"),
            "endpoint.yaml:3:15: 'key' is missing; write key: arm-1.key",
        ),
        (
            format!("{own}robots: {{arm: {{key: no.key}}}}\n"),
            "No such file or directory (os error 2); `ztl keys NAME` makes",
        ),
        (
            format!("{own}robots: {{arm: {{key: {name}.key_secret}}}}\n"),
            "is a secret key, which belongs to its owner only; expected the public one",
        ),
        (
            format!("robots: {{{arm}}}\n"),
            "endpoint.yaml:2:9: robots have keys only if the endpoint has one; write fleet-key:",
        ),
        (
            "fleet-key: no.key_secret\nrobots: {}\n".to_owned(),
            "No such file or directory (os error 2); `ztl keys NAME` makes",
        ),
        (
            format!("fleet-key: {name}.key\nrobots: {{}}\n"),
            "is a public key; expected the secret one of the same name, as NAME.key_secret",
        ),
        (
            key.clone(),
            "endpoint.yaml:2:6: with a key, only keys of 'client-keys' may use the endpoint, so nobody may",
        ),
        (
            anna.clone(),
            "endpoint.yaml:2:14: clients can have keys only if the endpoint has one",
        ),
        (
            format!("{key}client-keys: [no.key]\n"),
            "endpoint.yaml:3:15: ",
        ),
        (
            format!("{key}client-keys: [arm/lab={name}.key]\n"),
            "endpoint.yaml:3:15: scope 'arm/lab' does not begin with '/'",
        ),
        (
            format!("{key}client-keys: [/={name}.key]\n"),
            "endpoint.yaml:3:15: '/' does not begin with a robot's name; write it as /arm-1",
        ),
        (
            "log: debug\n".to_owned(),
            "endpoint.yaml:2:6: 'log' does nothing here",
        ),
        (
            "log-format: json\n".to_owned(),
            "endpoint.yaml:2:13: 'log-format' does nothing here",
        ),
    ] {
        assert_tells(&endpoint(&wrong), message);
    }
    // What only concerns its clients does not keep anybody from looking at the fleet, or from stopping it.
    let looked = mistakes_of(
        "endpoint",
        &format!("routers: tcp/h:7\n{key}client-keys: no.key\n"),
        |path| EndpointConfig::load(path).map(drop),
    );
    assert_eq!(looked, "");
    let robot = "name: a\nserver: tcp://h:7\nrouters: tcp/h:7\n";
    let clients = format!("client-keys: [{name}.key, /lab={name}.key]\n");
    assert_eq!(mistakes(&format!("{robot}{own}{clients}")), "");
    let server = format!("key: {name}.key_secret\nserver-key: {name}.key\n");
    assert_eq!(mistakes(&format!("{robot}{server}")), "");
    for (wrong, message) in [
        (
            clients,
            "agent.yaml:4:14: clients can have keys only if the robot has one",
        ),
        (
            own.clone(),
            "agent.yaml:4:12: with a fleet-key, only keys of 'client-keys' may use the robot, so nobody may",
        ),
        (
            format!("{own}client-keys: []\n"),
            "agent.yaml:5:14: with a fleet-key, only keys of 'client-keys'",
        ),
        (format!("{own}client-keys: no.key\n"), "agent.yaml:5:14: "),
        (
            format!("{own}client-keys: lab={name}.key\n"),
            "agent.yaml:5:14: scope 'lab' does not begin with '/'",
        ),
        (
            format!("key: {name}.key_secret\nserver-key: no.key\n"),
            "agent.yaml:5:13: ",
        ),
    ] {
        assert_tells(&mistakes(&format!("{robot}{wrong}")), message);
    }
    for file in files {
        std::fs::remove_file(file).unwrap();
    }
}
