//! Decides what the sender of a request may do, by the request's Host and Origin, its address and its token.

use std::net::IpAddr;

use axum::http::header::{AUTHORIZATION, COOKIE, FORWARDED, HOST, ORIGIN, VIA};
use axum::http::{HeaderMap, HeaderName, StatusCode};

use crate::tokens::Tokens;

/// What a client may do. Whoever may look may also stop, because a stop is safe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Role {
    /// Look and stop.
    Watcher,
    /// Also start.
    Operator,
}

impl Role {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Watcher => "watcher",
            Self::Operator => "operator",
        }
    }
}

/// Headers in which proxies name the client, besides `Forwarded`, `Via` and `X-Forwarded-…`.
const PROXY: [&str; 4] = [
    "cf-connecting-ip",
    "true-client-ip",
    "x-client-ip",
    "x-real-ip",
];

/// Headers in which browsers say which page sends a request, how, and what for.
const SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");
const FOR: HeaderName = HeaderName::from_static("sec-fetch-dest");

/// Checks requests.
pub(crate) struct Gate {
    tokens: Tokens,
    hosts: Vec<String>,
    cookie: String,
}

/// Why a request is refused.
pub(crate) type Refusal = (StatusCode, &'static str);

const FOREIGN: Refusal = (StatusCode::FORBIDDEN, "a page of another origin\n");

impl Gate {
    /// `port` is the console's own: browsers send a cookie to every port of a machine.
    pub(crate) fn new(tokens: Tokens, hosts: Vec<String>, port: u16) -> Self {
        Self {
            tokens,
            hosts,
            cookie: format!("ztl-console-{port}"),
        }
    }

    /// The name of the cookie that carries a token.
    pub(crate) fn cookie(&self) -> &str {
        &self.cookie
    }

    /// What the sender of a request may do. `is_linked`: pages of other origins may link to what it asks for.
    ///
    /// # Errors
    /// The answer for a sender who may do nothing.
    pub(crate) fn check(
        &self,
        peer: IpAddr,
        headers: &HeaderMap,
        query: Option<&str>,
        is_linked: bool,
    ) -> Result<Role, Refusal> {
        let host = only(headers, &HOST).filter(|host| self.is_ours(host));
        // Prevents DNS rebinding: a stranger's DNS can point any name to this machine.
        let host = host.ok_or((
            StatusCode::FORBIDDEN,
            "wrong Host: use an IP address, localhost, or a name given by --host\n",
        ))?;
        if headers.contains_key(ORIGIN) {
            let origin = only(headers, &ORIGIN).and_then(|origin| {
                let plain = origin.strip_prefix("http://");
                plain.or_else(|| origin.strip_prefix("https://"))
            });
            if !origin.is_some_and(|origin| origin.eq_ignore_ascii_case(host)) {
                return Err(FOREIGN);
            }
        }
        if !(comes_from_us(headers) || is_linked && is_followed(headers)) {
            return Err(FOREIGN);
        }
        let shown = self.shown(headers, query);
        let local = || self.is_local(peer, host, headers).then_some(Role::Operator);
        shown.or_else(local).ok_or((
            StatusCode::UNAUTHORIZED,
            "open the link again that `ztl web` printed\n",
        ))
    }

    /// What the owner of a token may do.
    pub(crate) fn role_of(&self, token: &str) -> Option<Role> {
        if same(token, &self.tokens.operator) {
            Some(Role::Operator)
        } else if same(token, &self.tokens.watcher) {
            Some(Role::Watcher)
        } else {
            None
        }
    }

    /// The role of the token that a request shows: in its link, its header or its cookies.
    fn shown(&self, headers: &HeaderMap, query: Option<&str>) -> Option<Role> {
        let bearer = || only(headers, &AUTHORIZATION)?.strip_prefix("Bearer ");
        let mut given = token_in(query)
            .into_iter()
            .chain(bearer())
            .chain(cookies(headers, &self.cookie));
        given.find_map(|token| self.role_of(token))
    }

    /// Whether a request certainly comes from a program on this machine. A proxy on this machine looks the same, so this is
    /// `false` if `hosts` are configured: then other machines or a proxy are expected.
    fn is_local(&self, peer: IpAddr, host: &str, headers: &HeaderMap) -> bool {
        let forwarded = |name: &HeaderName| {
            [FORWARDED, VIA].contains(name)
                || PROXY.contains(&name.as_str())
                || name.as_str().starts_with("x-forwarded-")
        };
        let name = name_of(host);
        self.hosts.is_empty()
            && peer.to_canonical().is_loopback()
            && (name.eq_ignore_ascii_case("localhost")
                || address(name).is_some_and(|address| address.is_loopback()))
            && !headers.keys().any(forwarded)
    }

    fn is_ours(&self, host: &str) -> bool {
        let name = name_of(host);
        address(name).is_some()
            || name.eq_ignore_ascii_case("localhost")
            || self
                .hosts
                .iter()
                .any(|host| host.eq_ignore_ascii_case(name))
    }
}

/// Whether a browser says that a request comes from our page or its user, or says nothing. A picture or a frame of another
/// page has no Origin.
fn comes_from_us(headers: &HeaderMap) -> bool {
    !headers.contains_key(SITE)
        || only(headers, &SITE).is_some_and(|site| ["same-origin", "none"].contains(&site))
}

/// Whether the browser follows a link.
fn is_followed(headers: &HeaderMap) -> bool {
    only(headers, &MODE) == Some("navigate") && only(headers, &FOR) == Some("document")
}

/// A Host without its port.
pub(crate) fn name_of(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
        _ => host,
    }
}

/// The IP address in a Host without its port.
fn address(name: &str) -> Option<IpAddr> {
    let inner = name
        .strip_prefix('[')
        .and_then(|name| name.strip_suffix(']'));
    inner.unwrap_or(name).parse().ok()
}

/// The value of a header that occurs once.
fn only<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    let mut values = headers.get_all(name).iter();
    let value = values.next()?.to_str().ok()?;
    values.next().is_none().then_some(value)
}

/// The token in the query of a link.
pub(crate) fn token_in(query: Option<&str>) -> Option<&str> {
    query?
        .split('&')
        .find_map(|pair| pair.strip_prefix("token="))
}

/// The values of the cookies with this name: another port of this machine may have set one, too.
fn cookies<'a>(headers: &'a HeaderMap, name: &'a str) -> impl Iterator<Item = &'a str> {
    let all = headers.get_all(COOKIE).iter();
    let all = all.filter_map(|all| all.to_str().ok());
    all.flat_map(|all| all.split(';')).filter_map(move |one| {
        let (given, value) = one.trim().split_once('=')?;
        (given == name).then_some(value)
    })
}

/// Compares in constant time.
fn same(given: &str, token: &str) -> bool {
    let differ = given
        .bytes()
        .zip(token.bytes())
        .fold(0, |all, (a, b)| all | (a ^ b));
    given.len() == token.len() && differ == 0
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use axum::http::HeaderValue;

    use super::*;

    const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);
    const ELSEWHERE: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 9));

    fn headers(pairs: &[(HeaderName, &'static str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(name, HeaderValue::from_static(value));
        }
        headers
    }

    fn gate(hosts: &[&str]) -> Gate {
        let tokens = Tokens {
            operator: "aa".to_owned(),
            watcher: "bb".to_owned(),
        };
        let hosts = hosts.iter().map(|host| (*host).to_owned()).collect();
        Gate::new(tokens, hosts, 1060)
    }

    fn refused(gate: &Gate, peer: IpAddr, pairs: &[(HeaderName, &'static str)]) -> Option<u16> {
        let checked = gate.check(peer, &headers(pairs), None, true);
        checked.err().map(|(status, _)| status.as_u16())
    }

    #[test]
    fn only_our_own_names_and_pages_pass() {
        let gate = gate(&["robot.local"]);
        let operator = (AUTHORIZATION, "Bearer aa");
        let refused = |pairs: &[_]| {
            let pairs: Vec<_> = pairs.iter().chain([&operator]).cloned().collect();
            refused(&gate, HERE, &pairs)
        };
        for host in [
            "127.0.0.1:1060",
            "localhost:1",
            "LOCALHOST",
            "[::1]:1060",
            "robot.local:9",
        ] {
            assert_eq!(refused(&[(HOST, host)]), None, "{host}");
        }
        for host in [
            "evil.example:1060",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example",
        ] {
            assert_eq!(refused(&[(HOST, host)]), Some(403), "{host}");
        }
        let here = (HOST, "127.0.0.1:1060");
        for origin in ["http://127.0.0.1:1060", "https://127.0.0.1:1060"] {
            assert_eq!(refused(&[here.clone(), (ORIGIN, origin)]), None, "{origin}");
        }
        for origin in [
            "http://127.0.0.1:8000",
            "http://localhost:1060",
            "null",
            "http://evil.example",
            "",
        ] {
            let pairs = [here.clone(), (ORIGIN, origin)];
            assert_eq!(refused(&pairs), Some(403), "{origin}");
        }
        let twice = (ORIGIN, "http://127.0.0.1:1060");
        assert_eq!(refused(&[here.clone(), twice.clone(), twice]), Some(403));
        assert_eq!(refused(&[here.clone(), here]), Some(403));
        assert_eq!(refused(&[]), Some(403));
    }

    #[test]
    fn a_page_of_another_origin_can_only_link_here() {
        let gate = gate(&[]);
        let status = |site, mode, used_for, is_linked| {
            let pairs = [
                (HOST, "127.0.0.1:1060"),
                (SITE, site),
                (MODE, mode),
                (FOR, used_for),
            ];
            let checked = gate.check(HERE, &headers(&pairs), None, is_linked);
            checked.err().map(|(status, _)| status.as_u16())
        };
        for (site, mode, used_for, linked, not_linked) in [
            ("same-origin", "no-cors", "image", None, None),
            ("none", "navigate", "document", None, None),
            ("cross-site", "navigate", "document", None, Some(403)),
            ("same-site", "navigate", "document", None, Some(403)),
            ("cross-site", "navigate", "iframe", Some(403), Some(403)),
            ("cross-site", "no-cors", "image", Some(403), Some(403)),
            ("same-site", "no-cors", "script", Some(403), Some(403)),
            ("", "", "", Some(403), Some(403)),
        ] {
            let told = [true, false].map(|is_linked| status(site, mode, used_for, is_linked));
            assert_eq!(told, [linked, not_linked], "{site} {mode} {used_for}");
        }
    }

    #[test]
    fn without_a_token_only_programs_of_this_machine_pass() {
        let gate = gate(&[]);
        let mapped = "::ffff:127.0.0.1".parse().expect("an address");
        for (peer, host) in [
            (HERE, "127.0.0.1:1060"),
            (HERE, "localhost"),
            (HERE, "LocalHost:9"),
            (mapped, "[::1]:1060"),
            (HERE, "127.5.5.5"),
        ] {
            assert_eq!(refused(&gate, peer, &[(HOST, host)]), None, "{host}");
        }
        for (peer, host) in [
            (HERE, "10.0.0.7:1060"),
            (HERE, "[fe80::1]"),
            (ELSEWHERE, "127.0.0.1:1060"),
            (ELSEWHERE, "localhost"),
            (ELSEWHERE, "10.0.0.7"),
        ] {
            assert_eq!(
                refused(&gate, peer, &[(HOST, host)]),
                Some(401),
                "{peer} {host}"
            );
        }
        let own = (HOST, "127.0.0.1:1060");
        for name in [
            "forwarded",
            "via",
            "x-forwarded-for",
            "x-forwarded-proto",
            "x-real-ip",
            "x-client-ip",
            "cf-connecting-ip",
            "true-client-ip",
        ] {
            let forwarded = (HeaderName::from_static(name), "127.0.0.1");
            assert_eq!(
                refused(&gate, HERE, &[own.clone(), forwarded]),
                Some(401),
                "{name}"
            );
        }
    }

    #[test]
    fn with_names_of_hosts_everybody_needs_a_token() {
        let gate = gate(&["robot.local"]);
        for host in ["robot.local", "127.0.0.1:1060", "localhost"] {
            assert_eq!(refused(&gate, HERE, &[(HOST, host)]), Some(401), "{host}");
        }
    }

    #[test]
    fn each_token_has_its_role() {
        let gate = gate(&[]);
        let role = |name: HeaderName, value, query| {
            let headers = headers(&[(HOST, "10.0.0.7"), (name, value)]);
            gate.check(ELSEWHERE, &headers, query, true)
                .map_err(|(status, _)| status.as_u16())
        };
        let (operator, watcher) = (Ok(Role::Operator), Ok(Role::Watcher));
        assert_eq!(role(COOKIE, "a=b; ztl-console-1060=aa", None), operator);
        assert_eq!(role(COOKIE, "ztl-console-1060=bb", None), watcher);
        assert_eq!(
            role(COOKIE, "ztl-console-1060=x; ztl-console-1060=bb", None),
            watcher
        );
        assert_eq!(role(AUTHORIZATION, "Bearer bb", None), watcher);
        assert_eq!(role(COOKIE, "x=y", Some("x=1&token=aa")), operator);
        for wrong in [
            "ztl-console-1060=",
            "ztl-console-1060=a",
            "ztl-console-1060=aaa",
            "ztl-console-1061=aa",
            "ztl-console=aa",
            "",
        ] {
            assert_eq!(role(COOKIE, wrong, None), Err(401), "{wrong}");
        }
        // Also on this machine, a watcher's link makes a watcher.
        let local = headers(&[(HOST, "127.0.0.1"), (COOKIE, "ztl-console-1060=bb")]);
        assert_eq!(
            gate.check(HERE, &local, None, true).ok(),
            Some(Role::Watcher)
        );
    }
}
