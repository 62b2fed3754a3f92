// Where the values of a grid's nodes lie: in a dense grid, or in bricks around a surface.
#pragma once

#include <cstdint>

#include "dcheck.h"
#include "trilinear.h"

namespace univoxel {

constexpr int kBrickShift = 2;
// Voxels along the side of a brick that is stored or skipped whole.
constexpr int64_t kBrick = int64_t(1) << kBrickShift;
constexpr int64_t kBrickMask = kBrick - 1;
constexpr int64_t kBrickNodes = kBrick * kBrick * kBrick;
// Bricks 0 and 1 stand for all that are missing outside and inside the surface.
constexpr int64_t kMissingBricks = 2;
constexpr int64_t kMissingRows = kMissingBricks * kBrickNodes;

struct Node {
    int64_t x, y, z;
};

/// Nodes of a dense grid, z fastest.
struct DenseNodes {
    int64_t size_y, size_z;

    int64_t row(int64_t x, int64_t y, int64_t z) const {
        DCHECK(x >= 0 && y >= 0 && y < size_y && z >= 0 && z < size_z);
        return (x * size_y + y) * size_z + z;
    }

    /// The nodes around a sample, by their numbers 0 .. 3 in its stencil along each axis.
    using Near = DenseNodes;
    template <class T>
    int64_t row(const Stencil3<T>& s, int a, int b, int c) const {
        return row(s.x.node[a], s.y.node[b], s.z.node[c]);
    }
    /// Whether the nodes first .. last along z follow each other.
    template <class T>
    bool run(const Stencil3<T>& s, int first, int last) const {
        return s.z.node[last] - s.z.node[first] == last - first;
    }
    template <class T>
    Near near(const Stencil3<T>&) const {
        return *this;
    }
};

/// Nodes in bricks of kBrick^3, z fastest in each; a table of bricks, z fastest, tells where one
/// lies.
struct BrickNodes {
    const int32_t* table;  // [A, B, C] number of a brick; 0 and 1: missing
    int64_t bricks_y, bricks_z;

    int64_t brick(int64_t a, int64_t b, int64_t c) const {
        DCHECK(a >= 0 && b >= 0 && b < bricks_y && c >= 0 && c < bricks_z);
        const int64_t number = table[(a * bricks_y + b) * bricks_z + c];
        DCHECK(number >= 0);
        return number;
    }
    int64_t row(int64_t x, int64_t y, int64_t z) const {
        return brick(x >> kBrickShift, y >> kBrickShift, z >> kBrickShift) * kBrickNodes +
               inside(x, y, z);
    }
    /// Number of a node within its brick, in [0, kBrickNodes).
    static int64_t inside(int64_t x, int64_t y, int64_t z) {
        return (x & kBrickMask) << 2 * kBrickShift | (y & kBrickMask) << kBrickShift |
               (z & kBrickMask);
    }
    /// The way back: the node of that number, counted from the first of its brick.
    static Node offset(int64_t inside) {
        DCHECK(inside >= 0 && inside < kBrickNodes);
        return {inside >> 2 * kBrickShift, inside >> kBrickShift & kBrickMask, inside & kBrickMask};
    }
    /// First node of the brick at a place of the table, counted through all its axes.
    Node first_node(int64_t place) const {
        DCHECK(place >= 0);  // the brick stands somewhere
        const int64_t c = place % bricks_z, ab = place / bricks_z;
        return {ab / bricks_y * kBrick, ab % bricks_y * kBrick, c * kBrick};
    }

    /// As in DenseNodes. A stencil meets at most two bricks along an axis: it looks up eight.
    struct Near {
        int64_t first_row[8];
        struct Axis {
            int32_t brick[4], inside[4];  // bit of the brick's number here, part of the row
        } x, y, z;

        template <class T>
        int64_t row(const Stencil3<T>&, int a, int b, int c) const {
            return first_row[x.brick[a] | y.brick[b] | z.brick[c]] +
                   (x.inside[a] | y.inside[b] | z.inside[c]);
        }
        template <class T>
        bool run(const Stencil3<T>&, int first, int last) const {
            return z.brick[first] == z.brick[last] &&
                   z.inside[last] - z.inside[first] == last - first;
        }
    };
    template <class T>
    Near near(const Stencil3<T>& s) const {
        Near n;
        const auto locate = [](const Stencil<T>& along, int shift, Near::Axis& axis) {
            for (int a = 0; a < 4; ++a) {
                const bool next = along.node[a] >> kBrickShift != along.node[0] >> kBrickShift;
                axis.brick[a] = next << shift;
                axis.inside[a] = static_cast<int32_t>(along.node[a] & kBrickMask)
                                 << kBrickShift * shift;
            }
        };
        locate(s.x, 2, n.x), locate(s.y, 1, n.y), locate(s.z, 0, n.z);
        for (int k = 0; k < 8; ++k) {
            const int64_t a = s.x.node[k & 4 ? 3 : 0] >> kBrickShift;
            const int64_t b = s.y.node[k & 2 ? 3 : 0] >> kBrickShift;
            n.first_row[k] = kBrickNodes * brick(a, b, s.z.node[k & 1 ? 3 : 0] >> kBrickShift);
        }
        return n;
    }
};

}  // namespace univoxel
