//! What components say of themselves.

use super::*;
use crate::describe::{ComponentDescription, Describe, Described, GoalRule};
use crate::description;

impl Describe for Motor<'_> {
    const DESCRIPTION: &'static str = description!(ComponentDescription {
        about: Some("turns until it is told to stop, or for some time"),
        ..ComponentDescription::new(GoalRule::NUMBER)
    });
}

fn motors(trace: &Trace) -> [Motor<'_>; 3] {
    [
        motor("a", Loss::Abort, trace),
        motor("h", Loss::Hold, trace),
        motor("c", Loss::CarryOn, trace),
    ]
}

fn described(trace: &Trace) -> Node<'static, Described<[Motor<'_>; 3]>, 2, 128> {
    Node::new(Identity::new("desk", "1", 77), Described(motors(trace)))
}

#[test]
fn descriptions_come_in_parts_by_the_indices_after_the_components() {
    let trace = Trace::default();
    let mut node = described(&trace);
    let mut gateway = gateway(&mut node);
    gateway.hello(5, 1);
    let description = <Motor<'_>>::DESCRIPTION;
    assert!((49..96).contains(&description.len()), "{description}");
    let (first, second) = description.as_bytes().split_at(48);
    for (component, [at_first, at_second]) in [[3, 4], [5, 6], [7, 8]].into_iter().enumerate() {
        for (index, bytes) in [(at_first, first), (at_second, second)] {
            let seq = index - 2;
            let heard = gateway.command(seq, Body::Describe { index });
            let component = component as u8;
            let expected = Body::Description {
                index,
                component,
                bytes,
            };
            assert_said(heard.clone(), &[&format!("{expected:?}")]);
            // An answer that was lost is sent again.
            assert_eq!(gateway.command(seq, Body::Describe { index }), heard);
        }
    }
    for (seq, index) in [(7, 9), (8, 10), (9, 255)] {
        let heard = gateway.command(seq, Body::Describe { index });
        assert_said(heard, &[&format!("{seq} Refused no such component")]);
    }
}

#[test]
fn an_older_gateway_notices_nothing_of_descriptions() {
    let (trace, other) = (Trace::default(), Trace::default());
    let mut node = described(&trace);
    let mut plain = TestNode::<2>::new(Identity::new("desk", "1", 77), motors(&other));
    let heard = play_older_gateway(gateway(&mut node));
    assert!(heard.len() > 10, "{heard:?}");
    assert_eq!(heard, play_older_gateway(gateway(&mut plain)));
}
