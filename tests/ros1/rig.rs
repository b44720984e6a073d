//! A master, and nodes in Python with rospy and actionlib.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::process::Command;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use ztl_ros1::xmlrpc::Value;
use ztl_ros1::{
    ActionClient, ActionTypes, Config, EndState, Goal, GoalEnd, GoalEvent, Node, WireType,
};
use ztl_tests::lab::{PATIENCE, Process, Scratch, reserve_port, until};

/// A real master, without memory: it forgets everything when it is killed.
pub(crate) struct Master {
    pub(crate) port: u16,
    process: Process,
    logs: Scratch,
}

impl Master {
    pub(crate) fn start() -> Self {
        Self::start_at(reserve_port())
    }

    fn start_at(port: u16) -> Self {
        let logs = Scratch::new();
        // The shared one ends with this program, whose end closes the pipe.
        let script =
            "rosmaster --core -p $0 & master=$!; echo process $master; read end; kill -9 $master";
        let mut command = Command::new("sh");
        command.args(["-c", script, &port.to_string()]);
        set_environment(&mut command, port, &logs);
        let process = Process::start(&mut command);
        let connect = || TcpStream::connect(("127.0.0.1", port)).ok();
        until("the master listens", PATIENCE, connect);
        Self {
            port,
            process,
            logs,
        }
    }

    /// The master of all tests that do not restart it.
    pub(crate) fn shared() -> &'static Self {
        static SHARED: OnceLock<Master> = OnceLock::new();
        SHARED.get_or_init(Self::start)
    }

    pub(crate) fn kill(&mut self) {
        self.process.close_stdin();
        self.process.wait_for_end_of_output();
    }

    /// Sends it a signal, such as `STOP`.
    pub(crate) fn signal(&self, name: &str) {
        let line = self.process.wait_for("process ");
        let process = line.split_once(' ').and_then(|(_, id)| id.parse().ok());
        ztl_tests::lab::signal(process.expect("its id"), name);
    }

    /// Starts a master at the same port.
    pub(crate) fn restart(&mut self) {
        *self = Self::start_at(self.port);
    }

    pub(crate) fn node(&self) -> Node {
        self.node_as("ztl", "127.0.0.1")
    }

    pub(crate) fn node_as(&self, name: &str, host: &str) -> Node {
        let config = Config {
            master: format!("http://127.0.0.1:{}", self.port),
            host: Some(host.to_owned()),
            name: name.to_owned(),
        };
        Node::start(&config).expect("a node")
    }

    /// A node in Python.
    pub(crate) fn robot(&self, arguments: &[&str]) -> Process {
        self.robot_at("127.0.0.1", arguments)
    }

    /// A node in Python that says it is at this host.
    pub(crate) fn robot_at(&self, host: &str, arguments: &[&str]) -> Process {
        let mut command = self.debian_python();
        command.env("ROS_HOSTNAME", host);
        command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/ros1/robot.py"));
        let process = Process::start(command.args(arguments));
        process.wait_for("ready");
        process
    }

    /// An action server in Python.
    pub(crate) fn action(&self, name: &str, topic: &str) -> Process {
        self.robot(&["action", name, topic])
    }

    pub(crate) fn debian_python(&self) -> Command {
        // Another Python on the PATH has no rospy.
        let mut command = Command::new("/usr/bin/python3");
        set_environment(&mut command, self.port, &self.logs);
        command
    }
}

impl Drop for Master {
    fn drop(&mut self) {
        // Killing the shell alone would leave the master behind.
        self.kill();
    }
}

fn set_environment(command: &mut Command, port: u16, logs: &Scratch) {
    command.env("ROS_MASTER_URI", format!("http://127.0.0.1:{port}"));
    command.env("ROS_HOSTNAME", "127.0.0.1");
    command.env("ROS_LOG_DIR", logs.path(""));
    command.env_remove("ROS_IP");
}

/// A name that no other test uses.
pub(crate) fn unique(name: &str) -> String {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    format!("{name}{}", NEXT.fetch_add(1, Ordering::Relaxed))
}

pub(crate) fn of(name: &str, md5: &str) -> WireType {
    WireType {
        name: name.to_owned(),
        md5: md5.to_owned(),
        definition: String::new(),
    }
}

pub(crate) fn string() -> WireType {
    of("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")
}

pub(crate) fn trigger() -> WireType {
    of("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522")
}

/// `actionlib/TestAction`
pub(crate) fn test_action() -> ActionTypes {
    ActionTypes {
        goal: of(
            "actionlib/TestActionGoal",
            "348369c5b403676156094e8c159720bf",
        ),
        feedback: of(
            "actionlib/TestActionFeedback",
            "6d3d0bf7fb3dda24779c010a9f3eb7cb",
        ),
        result: of(
            "actionlib/TestActionResult",
            "3d669e3a63aa986c667ea7b0f46ce85e",
        ),
    }
}

/// An encoded string.
pub(crate) fn text(text: &str) -> Vec<u8> {
    let len = u32::try_from(text.len()).unwrap().to_le_bytes();
    [&len, text.as_bytes()].concat()
}

/// A goal, and what was told of it.
pub(crate) struct Running {
    pub(crate) goal: Goal,
    events: Receiver<GoalEvent>,
}

impl Running {
    pub(crate) fn send(action: &ActionClient, goal: i32) -> Self {
        let (told, events) = channel();
        let content = goal.to_le_bytes().to_vec();
        let goal = action.send_goal(content, move |event| drop(told.send(event)));
        Self { goal, events }
    }

    #[track_caller]
    pub(crate) fn next(&self) -> GoalEvent {
        self.events.recv_timeout(PATIENCE * 2).expect("an event")
    }

    #[track_caller]
    pub(crate) fn accepted(&self) {
        assert_eq!(self.next(), GoalEvent::Accepted);
    }

    /// The end; feedback before it is skipped.
    #[track_caller]
    pub(crate) fn end(&self) -> GoalEnd {
        loop {
            match self.next() {
                GoalEvent::Ended(end) => return end,
                GoalEvent::Accepted | GoalEvent::Feedback(_) => {}
            }
        }
    }

    #[track_caller]
    pub(crate) fn ends(&self, state: EndState, text: &str, result: Option<i32>) {
        let end = self.end();
        let number = end
            .result
            .as_ref()
            .map(|bytes| i32::from_le_bytes(bytes[..].try_into().unwrap()));
        assert_eq!((end.state, &end.text[..], number), (state, text, result));
    }
}

/// The client of an action, once its server is connected: a busy machine may take longer for that than a goal waits.
#[track_caller]
pub(crate) fn connected(node: &Node, action: &str) -> ActionClient {
    let client = node.action(action, test_action()).unwrap();
    wait_for_server(&client);
    client
}

/// Waits until the action server is connected.
#[track_caller]
pub(crate) fn wait_for_server(action: &ActionClient) {
    wait("the action server is connected", || {
        Running::send(action, 1).end().state == EndState::Succeeded
    });
}

/// Waits until a goal is not sent for a reason with these parts: a busy machine may find out less while the first goals wait.
#[track_caller]
pub(crate) fn not_sent(action: &ActionClient, parts: &[&str]) -> String {
    until("a goal is not sent for this reason", PATIENCE, || {
        let end = Running::send(action, 1).end();
        println!("{end:?}");
        let is_it =
            end.state == EndState::NotSent && parts.iter().all(|part| end.text.contains(part));
        is_it.then_some(end.text)
    })
}

/// Repeats until it holds.
#[track_caller]
pub(crate) fn wait(what: &str, mut holds: impl FnMut() -> bool) {
    until(what, PATIENCE, || holds().then_some(()));
}

/// Runs it and asserts that it took less than the limit.
#[track_caller]
pub(crate) fn within<T>(limit: Duration, run: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let value = run();
    let took = start.elapsed();
    assert!(took < limit, "{took:?}");
    value
}

/// Connects to a topic of a node of ours, as a subscriber that reads only the header of the answer, and has little room for more.
#[track_caller]
pub(crate) fn listen(asker: &Node, node: &str, topic: &str, name: &str) -> TcpStream {
    let uri = until("the node is registered", PATIENCE, || {
        asker.ask_master("lookupNode", &[node.into()]).ok()
    });
    let protocols = Value::Array(vec![Value::Array(vec!["TCPROS".into()])]);
    let offer = asker.ask(
        uri.as_str().unwrap(),
        "requestTopic",
        &[topic.into(), protocols],
    );
    let port = offer.unwrap().as_array().unwrap()[2].as_int().unwrap();
    let mut stream = narrow(u16::try_from(port).unwrap());
    stream.write_all(&subscription(topic, name)).unwrap();
    let mut len = [0; 4];
    stream.read_exact(&mut len).unwrap();
    let mut header = vec![0; u32::from_le_bytes(len) as usize];
    stream.read_exact(&mut header).unwrap();
    stream
}

/// What a subscriber sends first.
pub(crate) fn subscription(topic: &str, name: &str) -> Vec<u8> {
    let fields = [
        &format!("callerid={name}"),
        &format!("topic={topic}"),
        "md5sum=*",
        "type=*",
    ];
    let fields: Vec<u8> = fields.iter().flat_map(|field| text(field)).collect();
    let len = u32::try_from(fields.len()).unwrap().to_le_bytes();
    [&len, &fields[..]].concat()
}

/// A connection that holds few bytes that were not read.
fn narrow(port: u16) -> TcpStream {
    use rustix::net::{AddressFamily, SocketType, connect, socket, sockopt};
    let socket = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
    sockopt::set_socket_recv_buffer_size(&socket, 2048).unwrap();
    connect(&socket, &SocketAddr::from(([127, 0, 0, 1], port))).unwrap();
    socket.into()
}

/// The node that publishes a topic.
#[track_caller]
pub(crate) fn publisher_of(asker: &Node, topic: &str) -> String {
    until("the topic is published", PATIENCE, || {
        let state = asker.ask_master("getSystemState", &[]).ok()?;
        let mut published = state.as_array()?.first()?.as_array()?.iter();
        published.find_map(|row| match row.as_array()? {
            [name, nodes] if name.as_str() == Some(topic) => {
                nodes.as_array()?.first()?.as_str().map(str::to_owned)
            }
            _ => None,
        })
    })
}
