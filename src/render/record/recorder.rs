//! Turns the events of traced paths into pages: arrays of footprints with links to the events they continue.

use crate::base::{Error, Result};
use crate::render::path::{Event, Visitor};
use crate::scatter::{BatchEvaluate, CHANNELS, Footprint};

/// A page is closed after the path with which it reaches this many events: what one evaluation touches stays in cache.
const PAGE_EVENTS: usize = 1024;

/// Some paths of one batch that reached a lamp, as a tree: its *nodes* are first the paths' starts at the camera, then
/// their bounces, each after the node it continues.
#[derive(Debug, Default)]
pub(super) struct Page {
    /// Nodes that are starts.
    pub(super) starts: usize,
    pub(super) bounces: Events,
    /// Nodes that depend on no parameter, and their weights; their footprints mean nothing.
    pub(super) reflections: Vec<(u32, [f32; CHANNELS])>,
    /// Per lamp: side branches that end there.
    pub(super) connections: Vec<Events>,
    /// Per lamp: nodes after which the path itself arrived there, and the factor.
    pub(super) arrivals: Vec<Vec<(u32, [f32; CHANNELS])>>,
    /// Per lamp and start: what the path contributed at the parameters of the recording; empty until that is known.
    pub(super) before: Vec<Vec<f32>>,
}

/// Uses of the scattering function.
#[derive(Debug, Default)]
pub(super) struct Events {
    /// `columns[k][event]`, the footprints.
    pub(super) columns: Vec<Vec<f32>>,
    /// What the weight contains beside `S`: cosine, densities, roulette.
    pub(super) factor: Vec<f32>,
    /// The node that the event continues.
    pub(super) parent: Vec<u32>,
    /// The set of parameters of its fiber; of the events past the end it is the first.
    pub(super) set: Vec<u8>,
}

impl Events {
    fn new(columns: usize) -> Self {
        Self {
            columns: vec![Vec::new(); columns],
            ..Self::default()
        }
    }

    fn push(&mut self, footprint: &Footprint, factor: f32, parent: u32, set: u8) {
        if set > 0 {
            self.set.resize(self.len(), 0);
            self.set.push(set);
        }
        for (column, x) in self.columns.iter_mut().zip(footprint) {
            column.push(*x);
        }
        self.factor.push(factor);
        self.parent.push(parent);
    }

    pub(super) fn len(&self) -> usize {
        self.factor.len()
    }

    fn shrink(&mut self) {
        self.columns.iter_mut().for_each(Vec::shrink_to_fit);
        self.factor.shrink_to_fit();
        self.parent.shrink_to_fit();
        self.set.shrink_to_fit();
    }

    fn bytes(&self) -> usize {
        (self.columns.len() + 2) * 4 * self.len()
            + self.set.len()
            + self.columns.len() * size_of::<Vec<f32>>()
    }
}

impl Page {
    fn new(columns: usize, n_lamps: usize) -> Self {
        Self {
            bounces: Events::new(columns),
            connections: (0..n_lamps).map(|_| Events::new(columns)).collect(),
            arrivals: vec![Vec::new(); n_lamps],
            ..Self::default()
        }
    }

    /// Replaces links to starts and to bounces by links to nodes, and gives back spare memory.
    fn number_nodes(&mut self) {
        let starts = self.starts as u32;
        let number = |link: &mut u32| {
            if *link & BOUNCE != 0 {
                *link = (*link & !BOUNCE) + starts;
            }
        };
        for events in std::iter::once(&mut self.bounces).chain(&mut self.connections) {
            events.parent.iter_mut().for_each(number);
            events.shrink();
        }
        for arrivals in &mut self.arrivals {
            arrivals.iter_mut().for_each(|(parent, _)| number(parent));
            arrivals.shrink_to_fit();
        }
        self.reflections.shrink_to_fit();
    }

    pub(super) fn events(&self) -> usize {
        let connections: usize = self.connections.iter().map(Events::len).sum();
        let arrivals: usize = self.arrivals.iter().map(Vec::len).sum();
        self.bounces.len() + connections + arrivals
    }

    pub(super) fn bytes(&self) -> usize {
        let lists = self.arrivals.iter().map(Vec::len).sum::<usize>() + self.reflections.len();
        let lamp = size_of::<Events>() + 2 * size_of::<Vec<f32>>() + 4 * self.starts;
        size_of::<Self>()
            + self.bounces.bytes()
            + self.connections.iter().map(Events::bytes).sum::<usize>()
            + self.connections.len() * lamp
            + lists * size_of::<(u32, [f32; CHANNELS])>()
    }
}

/// An event of the present path.
struct Step {
    depth: usize,
    kept: bool,
    what: What,
}

enum What {
    Bounce {
        footprint: Footprint,
        factor: f32,
        set: u8,
    },
    Reflect {
        weight: [f32; CHANNELS],
    },
    Connect {
        lamp: usize,
        footprint: Footprint,
        factor: f32,
        set: u8,
    },
    Arrive {
        lamp: usize,
        factor: [f32; CHANNELS],
    },
}

/// Marks the number of a bounce among links to starts, until their count is known.
const BOUNCE: u32 = 1 << 31;

/// Records paths into pages; [`Recorder::end_path`] must follow each.
pub(super) struct Recorder<'a> {
    kernel: &'a dyn BatchEvaluate,
    /// Events of the present path.
    path: Vec<Step>,
    /// Whether a kept event at this depth waits for the event it continues, while the path is read backward.
    awaited: Vec<bool>,
    /// The node after so many events, while the path is read forward.
    reached: Vec<u32>,
    open: Page,
    pages: Vec<Page>,
    fault: Option<Error>,
}

impl<'a> Recorder<'a> {
    pub(super) fn new(kernel: &'a dyn BatchEvaluate, n_lamps: usize) -> Self {
        Self {
            kernel,
            path: Vec::new(),
            awaited: Vec::new(),
            reached: Vec::new(),
            open: Page::new(kernel.columns(), n_lamps),
            pages: Vec::new(),
            fault: None,
        }
    }

    /// Keeps what of the present path leads to a lamp.
    pub(super) fn end_path(&mut self) {
        self.awaited.clear();
        for step in self.path.iter_mut().rev() {
            let needed = self.awaited.len().max(step.depth + 2);
            self.awaited.resize(needed, false);
            let leaf = matches!(step.what, What::Connect { .. } | What::Arrive { .. });
            step.kept = leaf || std::mem::take(&mut self.awaited[step.depth + 1]);
            self.awaited[step.depth] |= step.kept;
        }
        if self.awaited.first() == Some(&true) {
            self.write_path();
        }
        self.path.clear();
        if self.open.events() >= PAGE_EVENTS {
            self.close_page();
        }
    }

    fn write_path(&mut self) {
        let page = &mut self.open;
        self.reached.clear();
        self.reached.push(page.starts as u32);
        page.starts += 1;
        for step in self.path.iter().filter(|step| step.kept) {
            let parent = self.reached[step.depth];
            let node = BOUNCE | page.bounces.len() as u32;
            match &step.what {
                What::Bounce {
                    footprint,
                    factor,
                    set,
                } => page.bounces.push(footprint, *factor, parent, *set),
                What::Reflect { weight } => {
                    page.reflections.push((page.bounces.len() as u32, *weight));
                    page.bounces.push(&Footprint::default(), 0.0, parent, 0);
                }
                What::Connect {
                    lamp,
                    footprint,
                    factor,
                    set,
                } => {
                    page.connections[*lamp].push(footprint, *factor, parent, *set);
                    continue;
                }
                What::Arrive { lamp, factor } => {
                    page.arrivals[*lamp].push((parent, *factor));
                    continue;
                }
            }
            self.reached.truncate(step.depth + 1);
            self.reached.push(node);
        }
    }

    fn close_page(&mut self) {
        let empty = Page::new(self.kernel.columns(), self.open.connections.len());
        let mut page = std::mem::replace(&mut self.open, empty);
        if page.starts > 0 {
            page.number_nodes();
            self.pages.push(page);
        }
    }

    /// The pages once all paths have ended.
    pub(super) fn finish(mut self) -> Result<Vec<Page>> {
        self.close_page();
        match self.fault {
            Some(fault) => Err(fault),
            None => Ok(self.pages),
        }
    }

    /// The event's factor; one that `f32` cannot hold is a fault.
    fn factor(&mut self, event: &Event<'_>) -> f32 {
        let factor = event.factor as f32;
        if !factor.is_finite() && self.fault.is_none() {
            self.fault = Some(Error::new(format!(
                "an event at wi {}, wo {} cannot be recorded: its factor is {}",
                event.wi, event.wo, event.factor
            )));
        }
        factor
    }

    fn push(&mut self, depth: usize, what: What) {
        self.path.push(Step {
            depth,
            kept: false,
            what,
        });
    }
}

impl Visitor for Recorder<'_> {
    fn bounce(&mut self, depth: usize, event: Event<'_>) {
        let footprint = self.kernel.footprint(event.wi, event.wo, event.h);
        let (factor, set) = (self.factor(&event), event.set as u8);
        let what = What::Bounce {
            footprint,
            factor,
            set,
        };
        self.push(depth, what);
    }

    fn reflect(&mut self, depth: usize, weight: [f64; CHANNELS]) {
        let weight = weight.map(|w| w as f32);
        self.push(depth, What::Reflect { weight });
    }

    fn connect(&mut self, depth: usize, lamp: usize, event: Event<'_>) {
        let footprint = self.kernel.footprint(event.wi, event.wo, event.h);
        let (factor, set) = (self.factor(&event), event.set as u8);
        let what = What::Connect {
            lamp,
            footprint,
            factor,
            set,
        };
        self.push(depth, what);
    }

    fn arrive(&mut self, depth: usize, lamp: usize, factor: [f64; CHANNELS]) {
        let factor = factor.map(|f| f as f32);
        self.push(depth, What::Arrive { lamp, factor });
    }
}
