//! The part of HTTP/1.1 that XML-RPC needs: one request or response with a body of known length.

use std::fmt;

/// The longest start line with headers, in bytes.
const LONGEST_HEAD: usize = 16 * 1024;

/// Reads requests or responses from pieces of a connection.
#[derive(Debug)]
pub(crate) struct Reader {
    buffer: Vec<u8>,
    /// The longest body, in bytes.
    longest: usize,
    head: Option<Head>,
}

/// What is known once the head of a message has arrived.
#[derive(Debug, Clone, Copy)]
struct Head {
    /// Bytes of the head.
    len: usize,
    /// Bytes of the body. Without it, the body ends with the connection.
    body: Option<usize>,
    /// Of a response.
    status: Option<u16>,
    close: bool,
}

/// A request or response.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Message {
    pub(crate) body: Vec<u8>,
    /// Of a response.
    pub(crate) status: Option<u16>,
    /// Whether the sender closes the connection after this exchange.
    pub(crate) close: bool,
}

/// Why bytes are not a message that we take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum HttpError {
    /// Not HTTP/1.0 or 1.1, or a header without a colon.
    Malformed,
    TooLong {
        most: usize,
    },
    /// A body in chunks or compressed.
    Encoded,
    /// The connection ended within a message.
    Truncated,
}

impl fmt::Display for HttpError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Malformed => f.write_str("not a message of HTTP/1.1"),
            Self::TooLong { most } => write!(f, "an HTTP message longer than {most} bytes"),
            Self::Encoded => f.write_str("an HTTP body in chunks, which ROS does not send"),
            Self::Truncated => f.write_str("the connection ended within an HTTP message"),
        }
    }
}

impl Reader {
    /// Reads messages whose bodies have at most `longest` bytes.
    pub(crate) fn new(longest: usize) -> Self {
        Self {
            buffer: Vec::new(),
            longest,
            head: None,
        }
    }

    /// Takes a piece of the connection. At most one message and one piece are held.
    pub(crate) fn handle_bytes(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// The next message, once it is complete. `ended`: the connection has ended.
    pub(crate) fn poll_message(&mut self, ended: bool) -> Result<Option<Message>, HttpError> {
        let head = match self.head {
            Some(head) => head,
            None => {
                let Some(len) = head_len(&self.buffer) else {
                    return match (self.buffer.len(), ended) {
                        (0, _) => Ok(None),
                        (LONGEST_HEAD.., _) => Err(HttpError::TooLong { most: LONGEST_HEAD }),
                        (_, true) => Err(HttpError::Truncated),
                        (_, false) => Ok(None),
                    };
                };
                let head = Head::parse(self.buffer.get(..len).unwrap_or_default(), len)?;
                *self.head.insert(head)
            }
        };
        let arrived = self.buffer.len() - head.len.min(self.buffer.len());
        if head.body.unwrap_or(arrived) > self.longest {
            return Err(HttpError::TooLong { most: self.longest });
        }
        let len = match (head.body, ended) {
            (Some(len), _) if len <= arrived => len,
            (Some(_), true) => return Err(HttpError::Truncated),
            (None, true) => arrived,
            (_, false) => return Ok(None),
        };
        let rest = self.buffer.split_off(head.len + len);
        let body = std::mem::replace(&mut self.buffer, rest).split_off(head.len);
        self.head = None;
        Ok(Some(Message {
            body,
            status: head.status,
            close: head.close,
        }))
    }
}

/// The bytes of a complete head, with the empty line that ends it.
fn head_len(bytes: &[u8]) -> Option<usize> {
    let bytes = bytes.get(..bytes.len().min(LONGEST_HEAD))?;
    let crlf = bytes.windows(4).position(|four| four == b"\r\n\r\n");
    crlf.map(|at| at + 4)
}

impl Head {
    fn parse(bytes: &[u8], len: usize) -> Result<Self, HttpError> {
        let text = str::from_utf8(bytes).map_err(|_| HttpError::Malformed)?;
        let mut lines = text.split("\r\n").filter(|line| !line.is_empty());
        let mut first = lines.next().unwrap_or_default().split(' ');
        let words = [first.next(), first.next(), first.next()].map(Option::unwrap_or_default);
        let (version, status) = match words {
            [version, status, _] if version.starts_with("HTTP/") => {
                let status = status.parse().map_err(|_| HttpError::Malformed)?;
                (version, Some(status))
            }
            ["POST", _, version] => (version, None),
            _ => return Err(HttpError::Malformed),
        };
        let mut head = Self {
            len,
            // A request without a length has no body; a response has one up to the end.
            body: status.is_none().then_some(0),
            status,
            close: match version {
                "HTTP/1.0" => true,
                "HTTP/1.1" => false,
                _ => return Err(HttpError::Malformed),
            },
        };
        for line in lines {
            let (name, value) = line.split_once(':').ok_or(HttpError::Malformed)?;
            let (name, value) = (name.to_ascii_lowercase(), value.trim());
            match name.as_str() {
                "content-length" => {
                    head.body = Some(value.parse().map_err(|_| HttpError::Malformed)?);
                }
                "connection" if value.eq_ignore_ascii_case("close") => head.close = true,
                "connection" if value.eq_ignore_ascii_case("keep-alive") => head.close = false,
                "transfer-encoding" | "content-encoding"
                    if !value.eq_ignore_ascii_case("identity") =>
                {
                    return Err(HttpError::Encoded);
                }
                _ => {}
            }
        }
        Ok(head)
    }
}

/// A request to `host:port`.
pub(crate) fn request(authority: &str, body: &str) -> Vec<u8> {
    let len = body.len();
    // The path is what every client of XML-RPC sends; nobody looks at it.
    format!(
        "POST /RPC2 HTTP/1.1\r\nHost: {authority}\r\nContent-Type: text/xml\r\nContent-Length: {len}\r\n\
         Connection: close\r\n\r\n{body}"
    )
    .into_bytes()
}

/// The answer to a request.
pub(crate) fn response(body: &str, close: bool) -> Vec<u8> {
    let len = body.len();
    let connection = if close { "close" } else { "keep-alive" };
    format!(
        "HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: {len}\r\nConnection: {connection}\r\n\r\n{body}"
    )
    .into_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_arrive_in_any_pieces() {
        let mut bytes = request("lamp:1", "<one/>");
        bytes.extend(request("lamp:1", ""));
        bytes.extend(b"POST / HTTP/1.1\r\ncontent-length:3\r\n\r\nabc");
        for size in 1..bytes.len() {
            let mut reader = Reader::new(100);
            let mut bodies = Vec::new();
            for piece in bytes.chunks(size) {
                reader.handle_bytes(piece);
                while let Some(message) = reader.poll_message(false).unwrap() {
                    bodies.push(String::from_utf8(message.body).unwrap());
                }
            }
            assert_eq!(bodies, ["<one/>", "", "abc"], "{size}");
            assert_eq!(reader.poll_message(true), Ok(None));
        }
    }

    #[test]
    fn no_damage_panics() {
        let bytes = [response("<one/>", false), request("lamp:1", "<two/>")].concat();
        crate::damage::damage(&bytes, |damaged| {
            let mut reader = Reader::new(100);
            reader.handle_bytes(damaged);
            while let Ok(Some(_)) = reader.poll_message(true) {}
        });
    }

    #[test]
    fn a_response_without_a_length_ends_with_its_connection() {
        let mut reader = Reader::new(10);
        reader.handle_bytes(b"HTTP/1.0 200 OK\r\nServer: x\r\n\r\nab");
        assert_eq!(reader.poll_message(false), Ok(None));
        let message = reader.poll_message(true).unwrap().unwrap();
        assert_eq!((message.body, message.status), (b"ab".to_vec(), Some(200)));
        assert!(message.close);
    }

    #[test]
    fn what_is_too_long_or_malformed_is_refused() {
        let refused = |bytes: &[u8], ended| {
            let mut reader = Reader::new(10);
            reader.handle_bytes(bytes);
            reader.poll_message(ended).unwrap_err()
        };
        let post = |rest: &str| format!("POST / HTTP/1.1\r\n{rest}\r\n\r\n").into_bytes();
        let too_long = HttpError::TooLong { most: 10 };
        assert_eq!(refused(&post("Content-Length: 11"), false), too_long);
        let many = "x".repeat(LONGEST_HEAD);
        let too_long = HttpError::TooLong { most: LONGEST_HEAD };
        assert_eq!(refused(many.as_bytes(), false), too_long);
        for malformed in [post("Content-Length: -1"), post("x"), b"\r\n\r\n".to_vec()] {
            assert_eq!(refused(&malformed, false), HttpError::Malformed);
        }
        assert_eq!(
            refused(&post("Transfer-Encoding: chunked"), false),
            HttpError::Encoded
        );
        assert_eq!(
            refused(&post("Content-Length: 2"), true),
            HttpError::Truncated
        );
        assert_eq!(refused(b"POST /", true), HttpError::Truncated);
    }
}
