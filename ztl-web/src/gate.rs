//! Who may: the Host and Origin of each request, and the token of its cookie.

use std::net::IpAddr;

use axum::http::header::{AUTHORIZATION, COOKIE, HOST, ORIGIN};
use axum::http::{HeaderMap, HeaderName, StatusCode};

/// The name of the cookie.
pub(crate) const TOKEN_COOKIE: &str = "ztl-console";

/// What somebody may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// Look.
    Watcher,
    /// Start and stop.
    Operator,
}

/// The secrets of a console that others than this machine reach.
pub struct Tokens {
    /// Whoever has it may start and stop.
    pub operator: String,
    /// Whoever has it may look.
    pub watcher: String,
}

impl Tokens {
    /// New random tokens of 128 bits.
    ///
    /// # Errors
    /// If the system gives no random numbers.
    pub fn random() -> std::io::Result<Self> {
        let token = || {
            let mut bytes = [0; 16];
            getrandom::fill(&mut bytes).map_err(std::io::Error::other)?;
            Ok::<_, std::io::Error>(format!("{:032x}", u128::from_be_bytes(bytes)))
        };
        Ok(Self {
            operator: token()?,
            watcher: token()?,
        })
    }
}

/// Checks requests.
pub(crate) struct Gate {
    tokens: Option<Tokens>,
    hosts: Vec<String>,
}

/// Why a request is refused.
pub(crate) type Refusal = (StatusCode, &'static str);

impl Gate {
    pub(crate) fn new(tokens: Option<Tokens>, hosts: Vec<String>) -> Self {
        Self { tokens, hosts }
    }

    /// What the sender of a request may do.
    ///
    /// # Errors
    /// The answer for a sender who may do nothing.
    pub(crate) fn check(&self, headers: &HeaderMap, query: Option<&str>) -> Result<Role, Refusal> {
        let host = only(headers, &HOST).filter(|host| self.is_ours(host));
        // A name that a stranger's DNS points to this machine is not ours: DNS rebinding.
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
                return Err((StatusCode::FORBIDDEN, "a page of another origin\n"));
            }
        }
        self.role(headers, query).ok_or((
            StatusCode::UNAUTHORIZED,
            "open the link that `ztl web` has printed\n",
        ))
    }

    fn is_ours(&self, host: &str) -> bool {
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|byte| byte.is_ascii_digit()) => name,
            _ => host,
        };
        let address = name
            .strip_prefix('[')
            .and_then(|name| name.strip_suffix(']'));
        address.unwrap_or(name).parse::<IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || self
                .hosts
                .iter()
                .any(|host| host.eq_ignore_ascii_case(name))
    }

    fn role(&self, headers: &HeaderMap, query: Option<&str>) -> Option<Role> {
        let Some(tokens) = &self.tokens else {
            return Some(Role::Operator);
        };
        let bearer = || only(headers, &AUTHORIZATION)?.strip_prefix("Bearer ");
        let given = token_in(query)
            .or_else(bearer)
            .or_else(|| cookie(headers))?;
        if same(given, &tokens.operator) {
            Some(Role::Operator)
        } else if same(given, &tokens.watcher) {
            Some(Role::Watcher)
        } else {
            None
        }
    }
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

fn cookie(headers: &HeaderMap) -> Option<&str> {
    let cookies = headers
        .get_all(COOKIE)
        .iter()
        .filter_map(|all| all.to_str().ok());
    let mut cookies = cookies.flat_map(|all| all.split(';'));
    cookies.find_map(|cookie| {
        let (name, value) = cookie.trim().split_once('=')?;
        (name == TOKEN_COOKIE).then_some(value)
    })
}

/// Compares in a time that does not depend on where they differ.
fn same(given: &str, token: &str) -> bool {
    let differ = given
        .bytes()
        .zip(token.bytes())
        .fold(0, |all, (a, b)| all | (a ^ b));
    given.len() == token.len() && differ == 0
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    fn headers(pairs: &[(HeaderName, &'static str)]) -> HeaderMap {
        let mut headers = HeaderMap::new();
        for (name, value) in pairs {
            headers.append(name, HeaderValue::from_static(value));
        }
        headers
    }

    fn refused(gate: &Gate, pairs: &[(HeaderName, &'static str)]) -> Option<u16> {
        let checked = gate.check(&headers(pairs), None);
        checked.err().map(|(status, _)| status.as_u16())
    }

    #[test]
    fn only_our_own_names_and_pages_pass() {
        let gate = Gate::new(None, vec!["robot.local".to_owned()]);
        for host in [
            "127.0.0.1:1060",
            "localhost:1",
            "LOCALHOST",
            "[::1]:1060",
            "robot.local:9",
        ] {
            assert_eq!(refused(&gate, &[(HOST, host)]), None, "{host}");
        }
        for host in [
            "evil.example:1060",
            "localhost.evil.example",
            "",
            "127.0.0.1.evil.example",
        ] {
            assert_eq!(refused(&gate, &[(HOST, host)]), Some(403), "{host}");
        }
        let here = (HOST, "127.0.0.1:1060");
        for origin in ["http://127.0.0.1:1060", "https://127.0.0.1:1060"] {
            assert_eq!(
                refused(&gate, &[here.clone(), (ORIGIN, origin)]),
                None,
                "{origin}"
            );
        }
        for origin in [
            "http://127.0.0.1:8000",
            "http://localhost:1060",
            "null",
            "http://evil.example",
            "",
        ] {
            assert_eq!(
                refused(&gate, &[here.clone(), (ORIGIN, origin)]),
                Some(403),
                "{origin}"
            );
        }
        let twice = (ORIGIN, "http://127.0.0.1:1060");
        assert_eq!(
            refused(&gate, &[here.clone(), twice.clone(), twice]),
            Some(403)
        );
        assert_eq!(refused(&gate, &[here.clone(), here]), Some(403));
        assert_eq!(refused(&gate, &[]), Some(403));
    }

    #[test]
    fn each_token_has_its_role() {
        let tokens = Tokens {
            operator: "aa".to_owned(),
            watcher: "bb".to_owned(),
        };
        let gate = Gate::new(Some(tokens), Vec::new());
        let role = |name: HeaderName, value, query| {
            let headers = headers(&[(HOST, "10.0.0.7"), (name, value)]);
            gate.check(&headers, query)
                .map_err(|(status, _)| status.as_u16())
        };
        assert_eq!(
            role(COOKIE, "a=b; ztl-console=aa", None),
            Ok(Role::Operator)
        );
        assert_eq!(role(COOKIE, "ztl-console=bb", None), Ok(Role::Watcher));
        assert_eq!(role(AUTHORIZATION, "Bearer bb", None), Ok(Role::Watcher));
        assert_eq!(
            role(COOKIE, "x=y", Some("x=1&token=aa")),
            Ok(Role::Operator)
        );
        for wrong in [
            "ztl-console=",
            "ztl-console=a",
            "ztl-console=aaa",
            "ztl=aa",
            "",
        ] {
            assert_eq!(role(COOKIE, wrong, None), Err(401), "{wrong}");
        }
        let [first, second] = [(); 2].map(|()| Tokens::random().expect("random"));
        assert_ne!(first.operator, first.watcher);
        assert_ne!(first.operator, second.operator);
        assert_eq!(first.operator.len(), 32);
    }
}
