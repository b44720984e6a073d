//! `ztl web`: the web console.

use std::collections::BTreeSet;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, Sender, channel, sync_channel};
use std::time::Duration;

use qrcode::render::unicode::Dense1x2;
use qrcode::{EcLevel, QrCode};
use tracing::Level;
use ztl_script::PlayOptions;
use ztl_script::event::StampedEvent;
use ztl_std::{RemoteTask, Remotes};
use ztl_web::{Options, OwnPage, Publisher, Record, Robot, Show, ShowRecord, Tls, Tokens, serve};

use crate::chosen_publisher::ChosenPublisher;
use crate::connect_options::{ConnectOptions, warn_if_exposed};
use crate::exit::{Done, Misuse};
use crate::option_values::port;
use crate::remotes_options::RemotesOptions;
use crate::run_script::{self, RunRecord};
use crate::server_connection::connect;
use crate::terminal::{Errors, drawn_line, error_line, is_live, line, size};
use crate::{log, report, signals};

/// The original's port.
const PORT: u16 = 1060;
/// How long a show may take to abort its tasks when the console ends.
const END_LIMIT: Duration = Duration::from_secs(3);

#[derive(Debug, clap::Args)]
#[command(
    after_help = "Exit codes: 0 ended by Ctrl-C, 1 the console cannot run, 2 wrong options.\n\n\
    Everything that the page does goes over /rosbridge, for any rosbridge client (docs/web.md)."
)]
pub(crate) struct Web {
    #[command(flatten)]
    remotes: RemotesOptions,

    #[command(flatten)]
    connecting: ConnectOptions,

    /// Port of the console; 0 chooses a free one
    #[arg(short, long, default_value_t = PORT, value_parser = port)]
    port: u16,

    /// Address to serve at; for any other than 127.0.0.1 and ::1, the printed links are needed
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    bind: IpAddr,

    /// A name under which browsers reach this machine, besides its addresses (repeatable). Everybody then needs the
    /// printed links. Also needed behind a proxy
    #[arg(long, value_name = "NAME", value_parser = host)]
    host: Vec<String>,

    /// A page of one's own, with forms as for the original's ztl_web; the console's is then at /console
    #[arg(short, long, value_name = "PAGE.html")]
    serve: Option<PathBuf>,

    /// The bytes of this topic are sound in 16-bit samples: the page shows how loud it is (repeatable)
    #[arg(long, value_name = "TOPIC")]
    sound: Vec<String>,

    /// Keep the tokens of the links in this file, so that open pages go on when the console is started again
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,

    /// Play the scenes of this script (docs/web.md)
    #[arg(long, value_name = "SHOW.yaml")]
    script: Option<PathBuf>,

    /// Defaults for the script: timeout, on_failure, parallel, operator_gone
    #[arg(long, value_name = "FILE", requires = "script")]
    defaults: Option<PathBuf>,

    /// Record all events of the show: a line for each, or with a FILE.mcap together with all publishers of the
    /// configuration file (docs/record.md); FILE must not exist
    #[arg(long, value_name = "FILE", requires = "script")]
    record: Option<PathBuf>,

    /// PEM files of a certificate and its key: serve https
    #[arg(long, value_names = ["CERT", "KEY"], num_args = 2)]
    tls: Option<Vec<PathBuf>>,
}

impl Web {
    pub(crate) fn run(self) -> Done {
        signals::catch()?;
        // The console itself tells once that a robot is missing, and not at each try.
        log::init_to(Level::WARN, &[("remote-task", Level::ERROR)], || Errors);
        let remotes = self.remotes.read()?;
        let mut robots = Vec::new();
        for name in remotes.task_names() {
            let remote = remotes
                .task(name)
                .map_err(|wrong| Misuse(wrong.to_string()))?;
            let (endpoint, of_server) = (remote.endpoint(), remote.keys.clone());
            let (options, at) = (self.connecting.clone(), endpoint.clone());
            let connect = move |scope: &str| {
                let client = RemoteTask::connect(&at, scope).map_err(|error| error.to_string())?;
                let client = options.apply(client, of_server.as_ref());
                client.map_err(|error| error.to_string())
            };
            // A missing key is a mistake of now, not of the first task.
            connect(&remote.scope).map_err(Misuse)?;
            robots.push(Robot {
                name: name.to_owned(),
                endpoint,
                scope: remote.scope.clone(),
                keys: remote.keys.clone(),
                connect: Arc::new(connect),
            });
        }
        if robots.is_empty() {
            let file = self.remotes.path();
            let why = format!(
                "no robots: give --task NAME HOST PORT SCOPE, or `remotes:` in {}",
                file.display()
            );
            return Err(Misuse(why).into());
        }
        let tls = match self.tls.as_deref() {
            Some([certificate, key]) => {
                let tls = Tls::read(certificate, key).map_err(Misuse)?;
                warn_if_exposed(key);
                Some(tls)
            }
            _ => None,
        };
        let page = self.serve.as_ref().map(|path| {
            let wrong = |error| Misuse(format!("{}: {error}", path.display()));
            OwnPage::open(path.clone()).map_err(wrong)
        });
        let page = page.transpose()?;
        let mut publishers = Vec::new();
        for name in remotes.publisher_names() {
            let publisher = remotes
                .publisher(name)
                .map_err(|wrong| Misuse(wrong.to_string()))?;
            let (named, publisher, options) =
                (name.to_owned(), publisher.clone(), self.connecting.clone());
            let connect = move || {
                let publisher = ChosenPublisher::named(&named, publisher.clone());
                let connected = publisher.connect(&[], options.keys());
                connected
                    .map(|connected| connected.subscriber)
                    .map_err(|error| error.to_string())
            };
            // As above.
            connect().map_err(Misuse)?;
            publishers.push(Publisher {
                name: name.to_owned(),
                connect: Arc::new(connect),
            });
        }
        let (show, end_of_show) = match &self.script {
            None => (None, None),
            Some(script) => {
                let (show, end) = self.show(script, &remotes)?;
                (Some(show), Some(end))
            }
        };
        let place = (self.bind, self.port);
        let listener = TcpListener::bind(place).map_err(|error| {
            format!("cannot serve at {} port {}: {error}", self.bind, self.port)
        })?;
        let address = listener.local_addr()?;
        let tokens = match &self.tokens {
            None => Tokens::random()?,
            Some(path) => {
                let tokens = Tokens::kept(path);
                warn_if_exposed(path);
                tokens.map_err(|error| Misuse(format!("{}: {error}", path.display())))?
            }
        };
        let at = format!(
            "http{}://{}",
            if tls.is_some() { "s" } else { "" },
            self.place(address)
        );
        if self.bind.is_loopback() && self.host.is_empty() {
            line(format_args!("{at}/"));
        } else {
            for (who, token) in [
                ("watchers", &tokens.watcher),
                ("operators", &tokens.operator),
            ] {
                show_link(who, &format!("{at}/?token={token}"))?;
            }
        }
        let (ending, end) = channel();
        let failing = ending.clone();
        signals::then(move || drop(ending.send(None)));
        std::thread::Builder::new()
            .name("ztl-web".to_owned())
            .spawn(move || {
                let options = Options {
                    listener,
                    robots,
                    publishers,
                    sounds: self.sound.into_iter().collect(),
                    tokens,
                    hosts: self.host,
                    page,
                    show,
                    tls,
                };
                drop(failing.send(serve(options).err()));
            })?;
        let failed = end.recv()?;
        if let Some(end) = end_of_show {
            end.wait();
        }
        match failed {
            Some(error) => Err(error.into()),
            None => Ok(signals::exit_code_or(ExitCode::SUCCESS)),
        }
    }

    /// The show of a script, and what ends it.
    fn show(
        &self,
        path: &Path,
        remotes: &Remotes,
    ) -> Result<(Show, EndOfShow), Box<dyn std::error::Error>> {
        let script = run_script::load(path, self.defaults.as_deref())?;
        let notes = run_script::warnings(&"ztl", path, &script, Some(remotes));
        let options = PlayOptions {
            watch: true,
            remotes: run_script::known_remotes(&script, remotes),
            ..PlayOptions::default()
        };
        let words = self.defaults.as_ref().map_or_else(Vec::new, |path| {
            vec!["--defaults".to_owned(), path.display().to_string()]
        });
        let started = run_script::started((path, &script), (&self.remotes, remotes), words);
        let record = match &self.record {
            None => None,
            // The show looks for warnings by itself.
            Some(path) => {
                let events = RunRecord::create(path, (remotes, Default::default()), || {})?;
                Some(Record {
                    events: Box::new(events),
                    file: path.clone(),
                    report: report::of_running,
                })
            }
        };
        let (end, ending) = channel();
        let (ended, over) = sync_channel(0);
        let show = Show {
            script,
            options,
            connect: connect(remotes.clone(), self.connecting.clone()),
            started,
            notes,
            record,
            ending,
            ended,
        };
        Ok((show, EndOfShow { end, over }))
    }

    /// What browsers call the console: its host and port.
    fn place(&self, address: SocketAddr) -> String {
        match self.host.first() {
            Some(name) => format!("{name}:{}", address.port()),
            None => SocketAddr::new(reachable(self.bind), address.port()).to_string(),
        }
    }
}

/// A name of this machine, as browsers write it before the port. With anything else no request would come through.
fn host(text: &str) -> Result<String, &'static str> {
    let fits = |byte: u8| byte.is_ascii_alphanumeric() || b"-._".contains(&byte);
    match !text.is_empty() && text.bytes().all(fits) {
        true => Ok(text.to_owned()),
        false => Err("expected a name such as robot.local, without http:// and without a port"),
    }
}

/// Ends the show.
struct EndOfShow {
    end: Sender<()>,
    over: Receiver<()>,
}

impl EndOfShow {
    /// Lets the show abort its tasks, and waits for that.
    fn wait(self) {
        drop(self.end);
        // Nothing is ever sent.
        let _ = self.over.recv_timeout(END_LIMIT);
    }
}

impl ShowRecord for RunRecord {
    fn write(&mut self, event: &StampedEvent) -> Result<(), String> {
        self.write(event)
    }

    fn warnings(&self) -> Vec<String> {
        self.warnings()
    }

    fn finish(self: Box<Self>) -> Result<(), String> {
        (*self).finish()
    }
}

/// Serves the console for one robot to this machine until the process ends. Returns its link.
pub(crate) fn serve_on_this_machine(name: &str, endpoint: &str, scope: &str) -> io::Result<String> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    let link = format!("http://{}/", listener.local_addr()?);
    let at = endpoint.to_owned();
    let connect =
        move |scope: &str| RemoteTask::connect(&at, scope).map_err(|error| error.to_string());
    let options = Options {
        listener,
        robots: vec![Robot {
            name: name.to_owned(),
            endpoint: endpoint.to_owned(),
            scope: scope.to_owned(),
            keys: None,
            connect: Arc::new(connect),
        }],
        publishers: Vec::new(),
        sounds: BTreeSet::new(),
        show: None,
        tokens: Tokens::random()?,
        hosts: Vec::new(),
        page: None,
        tls: None,
    };
    let run = move || {
        if let Err(error) = serve(options) {
            error_line(format_args!("ztl: the console has ended: {error}"));
        }
    };
    let thread = std::thread::Builder::new().name("ztl-web".to_owned());
    thread.spawn(run)?;
    Ok(link)
}

/// The address of this machine at which others reach what is bound to `bind`; without a network, `bind`.
fn reachable(bind: IpAddr) -> IpAddr {
    // An address for documentation: it is only looked up by which interface it would be reached, nothing is sent.
    let far: IpAddr = match bind {
        IpAddr::V4(_) => Ipv4Addr::new(192, 0, 2, 1).into(),
        IpAddr::V6(_) => Ipv6Addr::new(0x2001, 0xdb8, 0, 0, 0, 0, 0, 1).into(),
    };
    let own = || {
        let socket = UdpSocket::bind((bind, 0))?;
        socket.connect((far, 9))?;
        io::Result::Ok(socket.local_addr()?.ip())
    };
    match bind.is_unspecified() {
        true => own().unwrap_or(bind),
        false => bind,
    }
}

/// Prints a link; on a terminal, also as a QR code for phones.
fn show_link(who: &str, link: &str) -> Result<(), String> {
    line(format_args!("{who}: {link}"));
    if !is_live() {
        return Ok(());
    }
    let code = QrCode::with_error_correction_level(link, EcLevel::L);
    let code = code.map_err(|error| format!("no QR code for {link}: {error}"))?;
    let drawn = code.render::<Dense1x2>().build();
    if drawn.lines().all(|row| row.chars().count() <= size().0) {
        for row in drawn.lines() {
            // Black on white, whatever the colours of the terminal are.
            drawn_line(&format!("\x1b[30;47m{row}\x1b[0m"));
        }
    }
    Ok(())
}
