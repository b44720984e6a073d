//! Reads calls and responses: the part of XML that XML-RPC uses, without attributes and document types.

use super::{DEPTH, ReadError, Response, Value};

/// Reads a call: its method and parameters.
///
/// # Errors
/// Where the bytes are not a call.
pub fn parse_call(bytes: &[u8]) -> Result<(String, Vec<Value>), ReadError> {
    let mut reader = Reader::new(bytes)?;
    reader.open("methodCall")?;
    reader.open("methodName")?;
    let method = reader.text()?.trim().to_owned();
    reader.close("methodName")?;
    let mut params = Vec::new();
    if reader.opens("params") {
        while reader.opens("param") {
            params.push(reader.value(DEPTH)?);
            reader.close("param")?;
        }
        reader.close("params")?;
    }
    reader.close("methodCall")?;
    Ok((method, params))
}

/// Reads a response.
///
/// # Errors
/// Where the bytes are not a response.
pub fn parse_response(bytes: &[u8]) -> Result<Response, ReadError> {
    let mut reader = Reader::new(bytes)?;
    reader.open("methodResponse")?;
    if reader.opens("fault") {
        let fault = reader.value(DEPTH)?;
        let text = match &fault {
            Value::Struct(members) => members.iter().find(|(name, _)| name == "faultString"),
            _ => None,
        };
        let text = text.and_then(|(_, text)| text.as_str()).unwrap_or_default();
        return Ok(Response::Fault(text.to_owned()));
    }
    reader.open("params")?;
    reader.open("param")?;
    let value = reader.value(DEPTH)?;
    reader.close("param")?;
    reader.close("params")?;
    reader.close("methodResponse")?;
    Ok(Response::Value(value))
}

struct Reader<'a> {
    text: &'a str,
    /// The offset of the next byte; always at a character.
    at: usize,
    /// An empty element, `<nil/>`, was opened: its end comes next.
    empty: Option<&'a str>,
}

impl<'a> Reader<'a> {
    fn new(bytes: &'a [u8]) -> Result<Self, ReadError> {
        let text = str::from_utf8(bytes).map_err(|_| ReadError::NotUtf8)?;
        let mut reader = Self {
            text,
            at: 0,
            empty: None,
        };
        // A byte order mark.
        reader.skip("\u{feff}");
        Ok(reader)
    }

    fn rest(&self) -> &'a str {
        self.text.get(self.at..).unwrap_or_default()
    }

    fn skip(&mut self, prefix: &str) -> bool {
        let found = self.rest().starts_with(prefix);
        if found {
            self.at += prefix.len();
        }
        found
    }

    /// Skips to behind `end`.
    fn skip_to(&mut self, end: &'static str) -> Result<&'a str, ReadError> {
        let skipped = self.rest().split_once(end);
        let (skipped, _) = skipped.ok_or(self.expected(end))?;
        self.at += skipped.len() + end.len();
        Ok(skipped)
    }

    fn expected(&self, what: &'static str) -> ReadError {
        ReadError::Expected { what, at: self.at }
    }

    /// Skips white space, comments and processing instructions.
    fn skip_space(&mut self) -> Result<(), ReadError> {
        loop {
            let rest = self.rest();
            self.at += rest.len() - rest.trim_start().len();
            if self.skip("<!--") {
                self.skip_to("-->")?;
            } else if self.skip("<?") {
                self.skip_to("?>")?;
            } else {
                return Ok(());
            }
        }
    }

    /// The name of the element that opens here, if one does; it stays unread.
    fn next_name(&mut self) -> Option<&'a str> {
        if self.empty.is_some() || self.skip_space().is_err() {
            return None;
        }
        let rest = self.rest().strip_prefix('<')?;
        let end = rest.find(['>', '/']).filter(|end| *end > 0)?;
        rest.get(..end).map(str::trim_end)
    }

    /// Opens the element if it comes next.
    fn opens(&mut self, name: &'static str) -> bool {
        match self.next_name() {
            Some(found) if found == name => self.open_any().is_ok(),
            _ => false,
        }
    }

    fn open(&mut self, name: &'static str) -> Result<(), ReadError> {
        match self.opens(name) {
            true => Ok(()),
            false => Err(self.expected(name)),
        }
    }

    fn open_any(&mut self) -> Result<&'a str, ReadError> {
        let name = self.next_name().ok_or(self.expected("an element"))?;
        let tag = self.skip_to(">")?;
        match tag.ends_with('/') {
            true => self.empty = Some(name),
            false => self.empty = None,
        }
        Ok(name)
    }

    fn close(&mut self, name: &str) -> Result<(), ReadError> {
        if let Some(empty) = self.empty.take() {
            return match empty == name {
                true => Ok(()),
                false => Err(self.expected("the end of an element")),
            };
        }
        self.skip_space()?;
        let tag = self.rest().strip_prefix("</").and_then(|rest| {
            let (found, _) = rest.split_once('>')?;
            (found.trim_end() == name).then_some(found.len() + "</>".len())
        });
        self.at += tag.ok_or(self.expected("the end of an element"))?;
        Ok(())
    }

    /// The text up to the next tag.
    fn text(&mut self) -> Result<String, ReadError> {
        let mut text = String::new();
        if self.empty.is_some() {
            return Ok(text);
        }
        loop {
            let rest = self.rest();
            let end = rest.find(['<', '&']).ok_or(self.expected("</"))?;
            text.push_str(rest.get(..end).unwrap_or_default());
            self.at += end;
            if self.skip("<!--") {
                self.skip_to("-->")?;
            } else if self.skip("<![CDATA[") {
                text.push_str(self.skip_to("]]>")?);
            } else if self.skip("&") {
                let name = self.skip_to(";")?;
                text.push(character(name).ok_or(self.expected("the name of a character"))?);
            } else {
                return Ok(text);
            }
        }
    }

    /// A `value` that may nest `depth` levels.
    fn value(&mut self, depth: usize) -> Result<Value, ReadError> {
        let depth = depth
            .checked_sub(1)
            .ok_or(ReadError::TooDeep { most: DEPTH })?;
        self.open("value")?;
        let start = self.at;
        let text = self.text()?;
        // Space before an element belongs to no string.
        let Some(name) = self.next_name().filter(|_| text.trim().is_empty()) else {
            self.close("value")?;
            return Ok(Value::String(text));
        };
        self.open_any()?;
        let value = match name {
            "array" => Value::Array(self.array(depth)?),
            "struct" => Value::Struct(self.members(depth)?),
            name => {
                let text = self.text()?;
                scalar(name, text).ok_or(ReadError::Expected {
                    what: "a value of XML-RPC",
                    at: start,
                })?
            }
        };
        self.close(name)?;
        self.close("value")?;
        Ok(value)
    }

    fn array(&mut self, depth: usize) -> Result<Vec<Value>, ReadError> {
        let mut items = Vec::new();
        self.open("data")?;
        while self.next_name() == Some("value") {
            items.push(self.value(depth)?);
        }
        self.close("data")?;
        Ok(items)
    }

    fn members(&mut self, depth: usize) -> Result<Vec<(String, Value)>, ReadError> {
        let mut members = Vec::new();
        while self.opens("member") {
            self.open("name")?;
            let name = self.text()?;
            self.close("name")?;
            members.push((name, self.value(depth)?));
            self.close("member")?;
        }
        Ok(members)
    }
}

fn scalar(name: &str, text: String) -> Option<Value> {
    let trimmed = text.trim();
    Some(match name {
        "nil" => Value::Nil,
        "boolean" => Value::Bool(match trimmed {
            "0" => false,
            "1" => true,
            _ => return None,
        }),
        "int" | "i4" | "i8" => Value::Int(trimmed.parse().ok()?),
        "double" => Value::Double(trimmed.parse().ok()?),
        "string" => Value::String(text),
        "base64" | "dateTime.iso8601" => Value::Raw(text),
        _ => return None,
    })
}

fn character(name: &str) -> Option<char> {
    Some(match name {
        "lt" => '<',
        "gt" => '>',
        "amp" => '&',
        "quot" => '"',
        "apos" => '\'',
        name => {
            let number = name.strip_prefix('#')?;
            let number = match number.strip_prefix('x') {
                Some(digits) => u32::from_str_radix(digits, 16),
                None => number.parse(),
            };
            char::from_u32(number.ok()?)?
        }
    })
}
