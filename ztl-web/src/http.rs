//! The connections of browsers: their limits, the files of the page, and the way to the socket.

use std::io;
use std::net::{IpAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Request, State};
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::net::TcpStream;

use crate::board::{Board, locked};
use crate::gate::{Gate, Role, TOKEN_COOKIE, token_in};
use crate::places::{Place, Places, Stranger, Strangers};
use crate::socket;

/// Most connections that have shown that they may look, and most of one address.
const CONNECTIONS: (usize, usize) = (256, 64);
/// The same of the others, and how long they may take to show it.
const STRANGERS: (usize, usize) = (64, 8);
const STRANGER: Duration = Duration::from_secs(5);
/// Most sockets, and most of one address.
const SOCKETS: (usize, usize) = (128, 32);
/// How long a browser may take for the head of a request.
const HEAD: Duration = Duration::from_secs(10);
/// Longest message of a client, in bytes.
const MESSAGE: usize = 64 * 1024;
/// Pause after an error of `accept`, such as too many open files.
const PAUSE: Duration = Duration::from_millis(50);

/// The files of the page: path, type, content.
#[rustfmt::skip]
const FILES: [(&str, &str, &str); 5] = [
    ("/", "text/html; charset=utf-8", include_str!("../assets/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("../assets/style.css")),
    ("/console.js", "text/javascript; charset=utf-8", include_str!("../assets/console.js")),
    ("/elements.js", "text/javascript; charset=utf-8", include_str!("../assets/elements.js")),
    ("/rosbridge.js", "text/javascript; charset=utf-8", include_str!("../assets/rosbridge.js")),
];

/// A page of another origin can neither frame, read nor script ours, and ours loads nothing foreign.
#[rustfmt::skip]
const HEADERS: [(&str, &str); 6] = [
    ("content-security-policy", "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
        img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cache-control", "no-store"),
];

#[derive(Clone)]
struct Console {
    board: Arc<Board>,
    gate: Arc<Gate>,
    connections: Places,
    sockets: Places,
}

/// A browser's connection: a stranger's until a request of it has passed the gate.
struct Connection {
    address: IpAddr,
    stands: Mutex<Standing>,
}

enum Standing {
    Stranger { _place: Stranger },
    Admitted { _place: Place },
}

impl Connection {
    fn is_stranger(&self) -> bool {
        matches!(*locked(&self.stands), Standing::Stranger { .. })
    }

    /// A request has passed the gate; returns whether there is room for the connection.
    fn admit(&self, connections: &Places) -> bool {
        if !self.is_stranger() {
            return true;
        }
        let place = connections.take(self.address);
        let admitted = place.map(|place| Standing::Admitted { _place: place });
        // Outside of the lock: dropping a place locks others.
        let before =
            admitted.map(|admitted| std::mem::replace(&mut *locked(&self.stands), admitted));
        before.is_some()
    }
}

/// Serves connections until the process ends.
///
/// # Errors
/// If the listener cannot be used.
pub(crate) async fn accept(listener: TcpListener, board: Arc<Board>, gate: Gate) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let app = router(Console {
        board,
        gate: Arc::new(gate),
        connections: Places::new(CONNECTIONS.0, CONNECTIONS.1),
        sockets: Places::new(SOCKETS.0, SOCKETS.1),
    });
    let strangers = Strangers::new(STRANGERS.0, STRANGERS.1);
    loop {
        let (stream, peer) = match listener.accept().await {
            Ok(accepted) => accepted,
            Err(error) => {
                tracing::warn!("cannot accept a connection: {error}");
                tokio::time::sleep(PAUSE).await;
                continue;
            }
        };
        // A short message must not wait for a longer one.
        let _ = stream.set_nodelay(true);
        strangers.add(peer.ip(), |stranger| {
            let connection = Arc::new(Connection {
                address: peer.ip(),
                stands: Mutex::new(Standing::Stranger { _place: stranger }),
            });
            tokio::spawn(serve(stream, app.clone(), connection)).abort_handle()
        });
    }
}

async fn serve(stream: TcpStream, app: Router, connection: Arc<Connection>) {
    let service = TowerToHyperService::new(app.layer(Extension(Arc::clone(&connection))));
    let served = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .serve_connection(TokioIo::new(stream), service)
        .with_upgrades();
    let too_long = async {
        tokio::time::sleep(STRANGER).await;
        if !connection.is_stranger() {
            std::future::pending::<()>().await;
        }
    };
    tokio::select! {
        // A browser may break its connection at any time.
        _ = served => {}
        () = too_long => {}
    }
}

fn router(console: Console) -> Router {
    let mut router = Router::new().route("/rosbridge", get(upgrade));
    for (path, kind, content) in FILES {
        let file = move || async move { ([(header::CONTENT_TYPE, kind)], content) };
        router = router.route(path, get(file));
    }
    let checked = from_fn_with_state(console.clone(), check);
    router.layer(checked).with_state(console)
}

/// Checks who may; a link with a token becomes a cookie. The connection of whoever may nothing is closed.
async fn check(
    State(console): State<Console>,
    Extension(connection): Extension<Arc<Connection>>,
    mut request: Request,
    next: Next,
) -> Response {
    let query = request.uri().query();
    let closed = [(header::CONNECTION, "close")];
    let mut response = match console.gate.check(request.headers(), query) {
        Err((status, why)) => (status, closed, why).into_response(),
        Ok(_) if !connection.admit(&console.connections) => {
            let why = "too many connections are open\n";
            (StatusCode::TOO_MANY_REQUESTS, closed, why).into_response()
        }
        Ok(_) if request.uri().path() == "/" && token_in(query).is_some() => link(request.uri()),
        Ok(role) => {
            request.extensions_mut().insert(role);
            next.run(request).await
        }
    };
    for (name, value) in HEADERS {
        let name = HeaderName::from_static(name);
        response
            .headers_mut()
            .insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Keeps the token of a link as a cookie, and leads to the page without it. By a page, not by a redirect: a browser
/// that comes from elsewhere would not send the cookie along.
fn link(uri: &Uri) -> Response {
    const PAGE: &str =
        "<!DOCTYPE html><title>ZTL</title><meta http-equiv=\"refresh\" content=\"0;url=/\">";
    let token = token_in(uri.query()).unwrap_or_default();
    let cookie = format!("{TOKEN_COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/");
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8".to_owned()),
        (header::SET_COOKIE, cookie),
    ];
    (headers, PAGE).into_response()
}

async fn upgrade(
    State(console): State<Console>,
    Extension(connection): Extension<Arc<Connection>>,
    Extension(role): Extension<Role>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let address = connection.address;
    let Some(place) = console.sockets.take(address) else {
        let why = "too many sockets are open\n";
        return (StatusCode::TOO_MANY_REQUESTS, why).into_response();
    };
    let upgrade = upgrade.max_message_size(MESSAGE).max_frame_size(MESSAGE);
    upgrade.on_upgrade(move |socket| async move {
        socket::serve(socket, console.board, address, role).await;
        drop(place);
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_small_and_loads_nothing_foreign() {
        let size: usize = FILES.iter().map(|(_, _, content)| content.len()).sum();
        assert!(size < 500_000, "{size}");
        for (path, _, content) in FILES {
            assert!(
                !content.contains("http://") && !content.contains("https://"),
                "{path}"
            );
            assert!(
                !content.contains("innerHTML") && !content.contains("eval("),
                "{path}"
            );
        }
    }
}
