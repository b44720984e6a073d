//! A request of the file, and what it is for a goal. A goal never becomes a part of the address, a header or JSON that
//! the file has not made for it.

use std::fmt::Write as _;
use std::path::PathBuf;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use ureq::http::{HeaderName, HeaderValue, Method, Uri};
use ztl_std::describe::GoalRule;
use ztl_yaml::{Fields, Node, closest};

use super::hosts::{Host, mistake};
use super::tls::Trust;
use crate::call::Call;
use crate::program::template::Template;
use crate::reader::ConfigReader;
use crate::secret;
use crate::value_template::ValueTemplate;

/// The longest secret, in bytes.
const LONGEST_SECRET: u64 = 4096;

/// A request with placeholders.
#[derive(Debug)]
pub(super) struct RequestTemplate {
    method: Method,
    /// As `http://10.0.0.7:80`.
    origin: String,
    /// Whom to trust, if it is encrypted.
    trust: Option<Trust>,
    path: Template,
    query: Option<Template>,
    headers: Vec<(HeaderName, Template)>,
    body: Option<BodyTemplate>,
    secret: Option<Secret>,
}

/// An address of the file.
struct Address {
    origin: String,
    trust: Option<Trust>,
    path: Template,
    query: Option<Template>,
}

#[derive(Debug)]
enum BodyTemplate {
    Json(ValueTemplate),
    Form(Vec<(String, Template)>),
}

/// A file with what proves who asks. It is read for each request, so that it may change.
#[derive(Debug)]
enum Secret {
    Bearer(PathBuf),
    /// `USER:PASSWORD`
    Basic(PathBuf),
}

/// A request for a task.
#[derive(Debug, Clone)]
pub(super) struct Filled {
    pub(super) method: Method,
    pub(super) uri: Uri,
    pub(super) trust: Option<Trust>,
    pub(super) headers: Vec<(HeaderName, HeaderValue)>,
    pub(super) body: Option<Vec<u8>>,
}

impl RequestTemplate {
    /// What it does, for messages: `POST http://10.0.0.7/api/halt`, without what comes from the goal.
    pub(super) fn name(&self) -> String {
        let path = self.path.beginning();
        format!("{} {}{path}", self.method, self.origin)
    }

    /// The request for a task.
    ///
    /// # Errors
    /// What of the goal does not fit, or which file has no secret.
    pub(super) fn fill(&self, call: &Call) -> Result<Filled, String> {
        let mut address = self.origin.clone();
        address.push_str(&self.path.fill_with(call, |value| match value {
            "" | "." | ".." => Err(format!("'{value}' cannot be a part of an address")),
            value => Ok(encoded(value)),
        })?);
        if let Some(query) = &self.query {
            address.push('?');
            address.push_str(&query.fill_with(call, |value| Ok(encoded(value)))?);
        }
        let uri = address.parse();
        let mut headers = Vec::new();
        for (name, template) in &self.headers {
            let text = template.fill(call)?;
            let value = HeaderValue::from_str(&text);
            let value = value.map_err(|_| format!("{text:?} cannot be the value of a header"))?;
            headers.push((name.clone(), value));
        }
        if let Some(secret) = &self.secret {
            headers.push((ureq::http::header::AUTHORIZATION, secret.header()?));
        }
        let body = match &self.body {
            Some(body) => {
                let (kind, body) = body.fill(call)?;
                let kind = HeaderValue::from_static(kind);
                headers.push((ureq::http::header::CONTENT_TYPE, kind));
                Some(body)
            }
            // A server may wait for a body otherwise.
            None if matches!(self.method, Method::POST | Method::PUT | Method::PATCH) => {
                Some(Vec::new())
            }
            None => None,
        };
        Ok(Filled {
            method: self.method.clone(),
            uri: uri.map_err(|error| format!("the address cannot be used: {error}"))?,
            trust: self.trust.clone(),
            headers,
            body,
        })
    }

    /// Whether it opens a WebSocket.
    pub(super) fn is_socket(&self) -> bool {
        self.origin.starts_with("ws")
    }

    /// Whether it has a body.
    pub(super) const fn has_body(&self) -> bool {
        self.body.is_some()
    }

    /// Whether it only asks: it is a `get`.
    pub(super) fn is_get(&self) -> bool {
        self.method == Method::GET
    }

    /// Whether it uses fields of the answer to the task's request.
    pub(super) fn uses_answer(&self) -> bool {
        let of_body = match &self.body {
            Some(BodyTemplate::Json(value)) => value.uses_answer(),
            Some(BodyTemplate::Form(fields)) => fields.iter().any(|(_, text)| text.uses_answer()),
            None => false,
        };
        let headers = self.headers.iter().map(|(_, template)| template);
        let mut texts = headers.chain([&self.path]).chain(&self.query);
        of_body || texts.any(Template::uses_answer)
    }

    /// Each part of the goal that it uses.
    pub(super) fn goal_paths(&self) -> Vec<&[String]> {
        let mut paths: Vec<&[String]> = self.path.goal_paths().collect();
        paths.extend(self.query.iter().flat_map(Template::goal_paths));
        let headers = self.headers.iter().map(|(_, template)| template);
        paths.extend(headers.flat_map(Template::goal_paths));
        match &self.body {
            Some(BodyTemplate::Json(value)) => value.goal_paths(&mut paths),
            Some(BodyTemplate::Form(fields)) => {
                let fields = fields.iter().map(|(_, template)| template);
                paths.extend(fields.flat_map(Template::goal_paths));
            }
            None => {}
        }
        paths
    }
}

impl BodyTemplate {
    /// The body for a task, and its type.
    fn fill(&self, call: &Call) -> Result<(&'static str, Vec<u8>), String> {
        match self {
            Self::Json(template) => {
                let value = template.fill(call)?;
                let json = serde_json::to_vec(&value).map_err(|error| error.to_string());
                Ok(("application/json", json?))
            }
            Self::Form(fields) => {
                let mut form = String::new();
                for (name, template) in fields {
                    let separator = if form.is_empty() { "" } else { "&" };
                    let value = encoded(&template.fill(call)?);
                    let _ = write!(form, "{separator}{}={value}", encoded(name));
                }
                Ok(("application/x-www-form-urlencoded", form.into_bytes()))
            }
        }
    }
}

impl Secret {
    const fn file(&self) -> &PathBuf {
        match self {
            Self::Bearer(file) | Self::Basic(file) => file,
        }
    }

    fn header(&self) -> Result<HeaderValue, String> {
        let file = self.file();
        let text = secret::read(file, LONGEST_SECRET)?;
        let text = text.trim();
        let value = match self {
            Self::Bearer(_) => format!("Bearer {text}"),
            Self::Basic(_) => format!("Basic {}", STANDARD.encode(text)),
        };
        let wrong = || format!("{}: a secret is one line of text", file.display());
        let mut value = HeaderValue::from_str(&value).map_err(|_| wrong())?;
        value.set_sensitive(true);
        match text.is_empty() {
            true => Err(wrong()),
            false => Ok(value),
        }
    }
}

/// A value as a part of an address or a form: nothing in it has a meaning there.
fn encoded(value: &str) -> String {
    let mut text = String::new();
    for byte in value.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' => {
                text.push(char::from(byte));
            }
            _ => {
                let _ = write!(text, "%{byte:02X}");
            }
        }
    }
    text
}

/// Which addresses are right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Schemes {
    /// `http` and `https`.
    Requests,
    /// Those, and `ws` and `wss`.
    Events,
}

pub(super) const METHODS: [(&str, Method); 5] = [
    ("get", Method::GET),
    ("post", Method::POST),
    ("put", Method::PUT),
    ("patch", Method::PATCH),
    ("delete", Method::DELETE),
];

impl<'d> ConfigReader<'d> {
    /// Reads the keys of a request.
    pub(super) fn http_request(
        &mut self,
        fields: &mut Fields<'d>,
        rule: &GoalRule,
        schemes: Schemes,
    ) -> Option<RequestTemplate> {
        let given = METHODS.map(|(key, method)| Some((fields.optional(key)?, method)));
        let mut given = given.into_iter().flatten();
        let (json, form) = (fields.optional("json"), fields.optional("form"));
        let headers = fields.optional("headers");
        let (bearer, basic) = (fields.optional("bearer"), fields.optional("basic"));
        let Some((address, method)) = given.next() else {
            let keys = METHODS.map(|(key, _)| key);
            fields.lacks_one_of(keys, "no request", "post: \"http://{robot}/api/halt\"");
            return None;
        };
        for (second, what) in [
            (
                given.next().map(|(node, _)| node),
                "get, post, put, patch, delete",
            ),
            (json.and(form), "json, form"),
            (bearer.and(basic), "bearer, basic"),
        ] {
            if let Some(second) = second {
                self.yaml.wrong(second, format!("give only one of: {what}"));
            }
        }
        let address = self.http_address(address, rule, schemes);
        if let (Some(body), true) = (json.or(form), method == Method::GET) {
            self.yaml
                .wrong(body, "get has no body; write it behind a ? of the address");
        }
        let body = match (json, form) {
            (Some(node), _) => Some(self.value_template(node, rule).map(BodyTemplate::Json)),
            (None, Some(node)) => Some(self.http_texts(node, rule).map(BodyTemplate::Form)),
            (None, None) => None,
        };
        let headers = headers.map(|node| self.http_headers(node, rule));
        let secret = match (bearer, basic) {
            (Some(node), _) => Some((node, self.http_secret(node).map(Secret::Bearer))),
            (None, Some(node)) => Some((node, self.http_secret(node).map(Secret::Basic))),
            (None, None) => None,
        };
        if let Some((node, Some(secret))) = &secret {
            match secret.header() {
                Ok(_) => self.warn_if_exposed(node, secret.file()),
                Err(mistake) => self.warn(node, format!("tasks will be rejected: {mistake}")),
            }
        }
        let Address {
            origin,
            trust,
            path,
            query,
        } = address?;
        Some(RequestTemplate {
            method,
            origin,
            trust,
            path,
            query,
            headers: match headers {
                Some(headers) => headers?,
                None => Vec::new(),
            },
            body: match body {
                Some(body) => Some(body?),
                None => None,
            },
            secret: match secret {
                Some((_, secret)) => Some(secret?),
                None => None,
            },
        })
    }

    /// Reads an address: its origin, path and query.
    fn http_address(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
        schemes: Schemes,
    ) -> Option<Address> {
        let what = match schemes {
            Schemes::Requests => "an address, as \"http://{robot}/api/halt\"",
            Schemes::Events => {
                "an address, as \"ws://{robot}/pubsub\" or \"http://{robot}/events\""
            }
        };
        let text = self.yaml.text(node, what)?;
        let read = self.read_address(text, rule, what, schemes);
        read.map_err(|mistake| self.yaml.wrong(node, mistake)).ok()
    }

    fn read_address(
        &self,
        text: &str,
        rule: &GoalRule,
        what: &str,
        schemes: Schemes,
    ) -> Result<Address, String> {
        let wrong = || format!("'{text}' is not {what}");
        let (scheme, rest) = text.split_once("://").ok_or_else(wrong)?;
        let is_encrypted = match (scheme, schemes) {
            ("http", _) | ("ws", Schemes::Events) => false,
            ("https", _) | ("wss", Schemes::Events) => true,
            _ => return Err(wrong()),
        };
        let end = rest.find(['/', '?']).unwrap_or(rest.len());
        let (host, rest) = rest.split_at_checked(end).ok_or_else(wrong)?;
        let Host { address, trust } = self.http_host(host)?;
        if rest.contains(|c: char| c == '#' || c.is_whitespace() || c.is_control()) {
            return Err(format!("{}: expected no '#' and no blanks", wrong()));
        }
        let (path, query) = match rest.split_once('?') {
            Some((path, query)) => (path, Some(query)),
            None => (rest, None),
        };
        let path = if path.is_empty() { "/" } else { path };
        if let (Some(_), false) = (&trust, is_encrypted) {
            return Err(format!(
                "'{text}' is not encrypted, and the host has a certificate: expected {scheme}s://"
            ));
        }
        let template = |text: &str| self.template(text, rule);
        let origin = format!("{scheme}://{address}");
        let path = template(path)?;
        let sample = format!("{origin}{}", path.sample());
        sample
            .parse::<Uri>()
            .map_err(|error| format!("{}: {error}", wrong()))?;
        Ok(Address {
            origin,
            trust: is_encrypted.then(|| trust.unwrap_or_else(Trust::system)),
            path,
            query: query.map(template).transpose()?,
        })
    }

    /// The host of an address, with its port, if it has one.
    fn http_host(&self, host: &str) -> Result<Host, String> {
        let Some(start) = host.find('{') else {
            let address = host.to_owned();
            return mistake(host).map_or(
                Ok(Host {
                    address,
                    trust: None,
                }),
                Err,
            );
        };
        let (before, from) = host.split_at(start);
        let named = from.get(1..).and_then(|from| from.split_once('}'));
        let (name, after) = named.ok_or_else(|| format!("'{host}' lacks a '}}'"))?;
        let known = self.http.get(name).ok_or_else(|| {
            let help = match closest(name, self.http.keys().map(String::as_str)) {
                Some(known) => format!("did you mean '{{{known}}}'?"),
                None if name.starts_with("goal") => "a client cannot choose the host".to_owned(),
                None => format!("write http: {{{name}: 10.0.0.7}} at the top of the file"),
            };
            format!("no host is called '{name}'; {help}")
        })?;
        let address = format!("{before}{}{after}", known.address);
        let host = Host {
            address,
            trust: known.trust.clone(),
        };
        if known.address.is_empty() {
            return Ok(Host {
                address: "unknown".to_owned(),
                trust: None,
            });
        }
        mistake(&host.address).map_or(Ok(host), Err)
    }

    /// Reads texts by their names.
    fn http_texts(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Vec<(String, Template)>> {
        let pairs = self
            .yaml
            .pairs(node, "fields with texts, as text: \"{goal}\"")?;
        let texts = pairs.iter().map(|(name, node)| {
            let name = self.yaml.text(name, "a name");
            let template = self.text_template(node, rule);
            Some((name?.to_owned(), template?))
        });
        let texts: Vec<_> = texts.collect();
        texts.into_iter().collect()
    }

    fn http_headers(
        &mut self,
        node: &'d Node,
        rule: &GoalRule,
    ) -> Option<Vec<(HeaderName, Template)>> {
        let pairs = self.yaml.pairs(node, "headers, as X-Robot: misty")?;
        let headers = pairs.iter().map(|(name, node)| {
            let name = self.yaml.parsed(name, "the name of a header", |text| {
                let name = HeaderName::from_bytes(text.as_bytes());
                let name = name.map_err(|_| format!("'{text}' cannot be the name of a header"))?;
                match name.as_str() {
                    "content-length" | "transfer-encoding" | "host" | "connection" => {
                        Err(format!("{name} follows from the request; leave it out"))
                    }
                    "authorization" => Err(
                        "write bearer: FILE or basic: FILE, so that the secret stays in a file"
                            .to_owned(),
                    ),
                    _ => Ok(name),
                }
            });
            let template = self.text_template(node, rule);
            Some((name?, template?))
        });
        let headers: Vec<_> = headers.collect();
        headers.into_iter().collect()
    }

    fn http_secret(&mut self, node: &'d Node) -> Option<PathBuf> {
        let path = self.yaml.text(node, "a file with the secret")?;
        Some(self.base.join(path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_that_never_ends_is_not_read() {
        let endless = Secret::Bearer("/dev/zero".into()).header();
        assert!(endless.is_err_and(|it| it == "/dev/zero: it is not a regular file"));
    }

    #[test]
    fn nothing_of_a_value_has_a_meaning_in_an_address() {
        assert_eq!(encoded("a-b_c.d~9"), "a-b_c.d~9");
        assert_eq!(
            encoded("../x?y=z&w#v %ü\r\n"),
            "..%2Fx%3Fy%3Dz%26w%23v%20%25%C3%BC%0D%0A"
        );
    }
}
