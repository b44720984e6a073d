//! Reads what all components of NAOqi need: `naoqi` at the top of the file, names and arguments.

use ztl_naoqi::Endpoint;
use ztl_std::describe::GoalRule;
use ztl_yaml::{Node, NodeValue};

use super::arguments::Arguments;
use super::connection::{Robot, token};
use super::names::{Used, What};
use crate::reader::ConfigReader;

impl<'d> ConfigReader<'d> {
    /// Reads `naoqi` at the top: where the robot's service directory listens, and who this client is.
    pub(crate) fn naoqi(&mut self, node: &'d Node) {
        let what = "the address of NAOqi, as tcp://127.0.0.1:9559";
        let mut user = None;
        let directory = match &node.value {
            NodeValue::Map(_) => {
                let Some(mut fields) = self.yaml.fields(node, "directory, user, token") else {
                    return;
                };
                let directory = fields.required("directory", "directory: tcp://127.0.0.1:9559");
                let (name, file) = (fields.optional("user"), fields.optional("token"));
                fields.finish(&mut self.yaml);
                match (name, file) {
                    (Some(name), Some(file)) => {
                        let name = self.yaml.text(name, "a user, as nao");
                        let path = self.yaml.text(file, "a file with the token");
                        if let (Some(name), Some(path)) = (name, path) {
                            let path = self.base.join(path);
                            match token(&path) {
                                Ok(_) => self.warn_if_exposed(file, &path),
                                Err(mistake) => {
                                    self.warn(file, format!("tasks will be rejected: {mistake}"));
                                }
                            }
                            user = Some((name.to_owned(), path));
                        }
                    }
                    (Some(other), None) | (None, Some(other)) => {
                        let message = "give both: user: nao, token: token.txt";
                        self.yaml.wrong(other, message);
                    }
                    (None, None) => {}
                }
                directory
            }
            _ => Some(node),
        };
        self.naoqi.place = directory.map(|node| self.yaml.mistake(node, ""));
        let directory = directory.and_then(|node| {
            let parsed = |text: &str| Endpoint::parse(text).map(|endpoint| endpoint.to_string());
            self.yaml.parsed(node, what, parsed)
        });
        if let Some(directory) = directory {
            self.naoqi.robot = Robot::new(directory, user);
        }
    }

    /// Reads a name with its service, as `ALMotion.moveTo`.
    pub(super) fn naoqi_name(&mut self, node: &'d Node, what: &str) -> Option<(String, String)> {
        self.yaml.parsed(node, what, |text| {
            let wrong = || format!("'{text}' is not {what}");
            let fits = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
            let (service, name) = text.split_once('.').ok_or_else(wrong)?;
            // A method may be followed by its signature.
            let bare = name.split_once("::").map_or(name, |(name, _)| name);
            let good = |part: &str| !part.is_empty() && part.chars().all(fits);
            match good(service) && good(bare) {
                true => Ok((service.to_owned(), name.to_owned())),
                false => Err(wrong()),
            }
        })
    }

    /// Reads arguments for goals of this rule.
    pub(super) fn naoqi_arguments(&mut self, node: &'d Node, rule: &GoalRule) -> Option<Arguments> {
        let nodes = self.yaml.list(node, "arguments, as [\"{goal}\", 0.5]")?;
        let arguments: Vec<_> = nodes
            .iter()
            .map(|node| self.value_template(node, rule))
            .collect();
        Some(Arguments(arguments.into_iter().collect::<Option<_>>()?))
    }

    /// Notes what the file uses.
    pub(super) fn naoqi_uses(&mut self, node: &'d Node, service: &str, what: What) {
        self.naoqi.used.push(Used {
            place: self.yaml.mistake(node, ""),
            service: service.to_owned(),
            what,
        });
    }
}
