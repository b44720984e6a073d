//! The connections of browsers: their limits, the files of the page, and the way to the socket.

use std::io;
use std::net::{IpAddr, TcpListener};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::header::{self, HeaderName, HeaderValue};
use axum::http::{HeaderMap, Method, StatusCode, Uri};
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{Html, IntoResponse, Response};
use axum::routing::get;
use axum::{Extension, Router};
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::task::spawn_blocking;

use crate::board::Board;
use crate::gate::{Gate, Role, name_of, token_in};
use crate::lock::locked;
use crate::own_page::{OwnPage, Posted};
use crate::places::{Place, Places, Stranger, Strangers};
use crate::record::RecordFile;
use crate::socket;
use crate::tls::Tls;

/// Most connections that have shown that they may look, and most of one address.
const CONNECTIONS: (usize, usize) = (256, 64);
/// The same of the others, and how long they may take to show it.
const STRANGERS: (usize, usize) = (64, 8);
const STRANGER: Duration = Duration::from_secs(5);
/// Most sockets, and most of one address.
const SOCKETS: (usize, usize) = (128, 32);
/// How long a browser may take for the head of a request, and to agree on encryption.
const HEAD: Duration = Duration::from_secs(10);
/// Longest message of a client, in bytes.
const MESSAGE: usize = 64 * 1024;
/// Pause after an error of `accept`, such as too many open files.
const PAUSE: Duration = Duration::from_millis(50);

/// The files of the page: path, type, content.
#[rustfmt::skip]
const FILES: [(&str, &str, &str); 13] = [
    ("/", "text/html; charset=utf-8", include_str!("../assets/index.html")),
    ("/style.css", "text/css; charset=utf-8", include_str!("../assets/style.css")),
    ("/console.js", "text/javascript; charset=utf-8", include_str!("../assets/console.js")),
    ("/form.js", "text/javascript; charset=utf-8", include_str!("../assets/form.js")),
    ("/fields.js", "text/javascript; charset=utf-8", include_str!("../assets/fields.js")),
    ("/show.js", "text/javascript; charset=utf-8", include_str!("../assets/show.js")),
    ("/ready.js", "text/javascript; charset=utf-8", include_str!("../assets/ready.js")),
    ("/past.js", "text/javascript; charset=utf-8", include_str!("../assets/past.js")),
    ("/robots.js", "text/javascript; charset=utf-8", include_str!("../assets/robots.js")),
    ("/streams.js", "text/javascript; charset=utf-8", include_str!("../assets/streams.js")),
    ("/operator.js", "text/javascript; charset=utf-8", include_str!("../assets/operator.js")),
    ("/elements.js", "text/javascript; charset=utf-8", include_str!("../assets/elements.js")),
    ("/rosbridge.js", "text/javascript; charset=utf-8", include_str!("../assets/rosbridge.js")),
];

/// A page of another origin can neither frame, read nor script ours, and ours loads nothing foreign.
#[rustfmt::skip]
const HEADERS: [(&str, &str); 6] = [
    ("content-security-policy", "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; \
        img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cross-origin-opener-policy", "same-origin"),
    ("cross-origin-resource-policy", "same-origin"),
    ("cache-control", "no-store"),
];

/// A page of one's own may contain anything, but nobody may frame it. Without a referrer, the Origin of its forms would
/// be `null`.
const OWN: [(&str, &str); 2] = [
    ("content-security-policy", "frame-ancestors 'none'"),
    ("referrer-policy", "same-origin"),
];

/// What a browser shows that comes without a token.
const LOCKED: &str = "<!DOCTYPE html><html lang=\"en\"><title>ZTL console: no access</title>\
    <meta name=\"viewport\" content=\"width=device-width\"><meta name=\"color-scheme\" content=\"light dark\">\
    <main><h1>This page needs its link</h1><p>Open the link again that <code>ztl web</code> printed. \
    Each start of the console makes new links.</p></main></html>";

#[derive(Clone)]
struct Console {
    board: Arc<Board>,
    gate: Arc<Gate>,
    connections: Places,
    page: Option<Arc<OwnPage>>,
    record: Option<Arc<RecordFile>>,
    is_encrypted: bool,
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
    fn admit(&self, connections: &Places, role: Role) -> bool {
        if !self.is_stranger() {
            return true;
        }
        let place = connections.take(self.address, role);
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
pub(crate) async fn accept(
    listener: TcpListener,
    board: Arc<Board>,
    gate: Gate,
    (page, record): (Option<OwnPage>, Option<RecordFile>),
    tls: Option<Tls>,
) -> io::Result<()> {
    let listener = tokio::net::TcpListener::from_std(listener)?;
    let app = router(Console {
        board,
        gate: Arc::new(gate),
        connections: Places::new(CONNECTIONS.0, CONNECTIONS.1),
        page: page.map(Arc::new),
        record: record.map(Arc::new),
        is_encrypted: tls.is_some(),
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
        let tls = tls.clone();
        strangers.add(peer.ip(), |stranger| {
            let connection = Arc::new(Connection {
                address: peer.ip(),
                stands: Mutex::new(Standing::Stranger { _place: stranger }),
            });
            tokio::spawn(serve(stream, tls, app.clone(), connection)).abort_handle()
        });
    }
}

async fn serve(stream: TcpStream, tls: Option<Tls>, app: Router, connection: Arc<Connection>) {
    let app = app.layer(Extension(Arc::clone(&connection)));
    let served = async {
        match tls {
            None => answer(stream, app).await,
            Some(Tls(acceptor)) => {
                // A browser that does not trust the certificate breaks off.
                if let Ok(stream) = acceptor.accept(stream).await {
                    answer(stream, app).await;
                }
            }
        }
    };
    let too_long = async {
        tokio::time::sleep(STRANGER).await;
        if !connection.is_stranger() {
            std::future::pending::<()>().await;
        }
    };
    tokio::select! {
        () = served => {}
        () = too_long => {}
    }
}

/// Answers the requests of a connection.
async fn answer(stream: impl AsyncRead + AsyncWrite + Unpin + Send + 'static, app: Router) {
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .serve_connection(TokioIo::new(stream), TowerToHyperService::new(app))
        .with_upgrades();
    // A browser may break its connection at any time.
    let _ = connection.await;
}

fn router(console: Console) -> Router {
    let mut router = Router::new()
        .route("/rosbridge", get(upgrade))
        .route("/picture/{number}", get(picture));
    for (path, kind, content) in FILES {
        let file = move || async move { ([(header::CONTENT_TYPE, kind)], content) };
        let path = match console.page.is_some() && path == "/" {
            true => "/console",
            false => path,
        };
        router = router.route(path, get(file));
    }
    if let Some(record) = &console.record {
        let (whole, reported) = (Arc::clone(record), Arc::clone(record));
        let download = get(async move || whole.download().await);
        let report = get(async move || reported.report().await);
        router = router.route("/record", download).route("/report", report);
    }
    if let Some(page) = &console.page {
        let (shown, posted) = (Arc::clone(page), Arc::clone(page));
        let own = get(async move |uri: Uri| own_page(&shown, uri.path()).await);
        router = router.fallback_service(own.post(post).with_state((console.clone(), posted)));
    }
    let checked = from_fn_with_state(console.clone(), check);
    let limit = DefaultBodyLimit::max(MESSAGE);
    router.layer(limit).layer(checked).with_state(console)
}

/// Checks who may; a link with a token becomes a cookie. The connection of whoever may nothing is closed.
async fn check(
    State(console): State<Console>,
    Extension(connection): Extension<Arc<Connection>>,
    mut request: Request,
    next: Next,
) -> Response {
    let path = request.uri().path();
    let is_page = path == "/";
    // A link posts no form. A report takes time and memory: only our own page, or whoever types it, asks for one.
    let is_linked = request.method() == Method::GET && !["/record", "/report"].contains(&path);
    let query = request.uri().query();
    let token = token_in(query).filter(|token| console.gate.role_of(token).is_some());
    let checked = console
        .gate
        .check(connection.address, request.headers(), query, is_linked);
    let closed = [(header::CONNECTION, "close")];
    let mut response = match (checked, token) {
        (Err((StatusCode::UNAUTHORIZED, _)), _) if is_page => {
            (StatusCode::UNAUTHORIZED, closed, Html(LOCKED)).into_response()
        }
        (Err((status, why)), _) => (status, closed, why).into_response(),
        (Ok(role), _) if !connection.admit(&console.connections, role) => {
            let why = "too many connections are open\n";
            (StatusCode::TOO_MANY_REQUESTS, closed, why).into_response()
        }
        (Ok(_), Some(token)) if is_page => link(&console, token),
        (Ok(role), _) => {
            request.extensions_mut().insert(role);
            next.run(request).await
        }
    };
    for (name, value) in HEADERS {
        let name = HeaderName::from_static(name);
        let headers = response.headers_mut();
        headers
            .entry(name)
            .or_insert(HeaderValue::from_static(value));
    }
    response
}

/// Keeps the token of a link as a cookie, and leads to the page without it. By a page, not by a redirect: a browser
/// that comes from elsewhere would not send the cookie along.
fn link(console: &Console, token: &str) -> Response {
    const PAGE: &str =
        "<!DOCTYPE html><title>ZTL</title><meta http-equiv=\"refresh\" content=\"0;url=/\">";
    let secure = if console.is_encrypted { "; Secure" } else { "" };
    let cookie = format!(
        "{}={token}; HttpOnly; SameSite=Strict; Path=/{secure}",
        console.gate.cookie()
    );
    ([(header::SET_COOKIE, cookie)], Html(PAGE)).into_response()
}

/// The newest picture of a stream. Not over the socket, where it would delay what is urgent.
async fn picture(State(console): State<Console>, uri: Uri) -> Response {
    let number = uri.path().rsplit('/').next();
    let number = number.and_then(|number| number.parse().ok());
    match number.and_then(|number| console.board.streams.picture(number)) {
        Some((kind, bytes)) => ([(header::CONTENT_TYPE, kind)], bytes).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}

/// A page of one's own, read anew each time. As from the original, its path ends in `/`.
async fn own_page(page: &OwnPage, path: &str) -> Response {
    if !path.ends_with('/') {
        // One slash, because two of them would name another host.
        let place = format!("/{}/", path.trim_start_matches('/'));
        return (StatusCode::SEE_OTHER, [(header::LOCATION, place)]).into_response();
    }
    let path = page.path.clone();
    // A slow disk must not delay the sockets.
    match spawn_blocking(move || OwnPage::read(&path)).await {
        Ok(Ok(content)) => (OWN, Html(content)).into_response(),
        Ok(Err(error)) => {
            let why = format!("cannot read {}: {error}\n", page.path.display());
            (StatusCode::INTERNAL_SERVER_ERROR, why).into_response()
        }
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// A form of one's own page.
async fn post(
    State((console, page)): State<(Console, Arc<OwnPage>)>,
    Extension(connection): Extension<Arc<Connection>>,
    Extension(role): Extension<Role>,
    uri: Uri,
    headers: HeaderMap,
    form: Bytes,
) -> Response {
    match page.post(&console.board, &form, role, connection.address) {
        Ok(Posted::Page) => own_page(&page, &format!("{}/", uri.path())).await,
        Ok(Posted::Port(port)) => {
            let host = headers
                .get(header::HOST)
                .and_then(|host| host.to_str().ok());
            let scheme = if console.is_encrypted {
                "https"
            } else {
                "http"
            };
            let place = format!("{scheme}://{}:{port}", name_of(host.unwrap_or_default()));
            (StatusCode::SEE_OTHER, [(header::LOCATION, place)]).into_response()
        }
        Err(why) => why.into_response(),
    }
}

async fn upgrade(
    State(console): State<Console>,
    Extension(connection): Extension<Arc<Connection>>,
    Extension(role): Extension<Role>,
    upgrade: WebSocketUpgrade,
) -> Response {
    let address = connection.address;
    let Some(place) = console.sockets.take(address, role) else {
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
