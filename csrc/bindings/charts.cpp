#include <xatlas.h>

#include <memory>

#include "bindings/common.h"
#include "texels.h"

namespace univoxel {
namespace {

struct Destroy {
    void operator()(xatlas::Atlas* atlas) const { xatlas::Destroy(atlas); }
};

/// A mesh of triangles cut into charts, which are packed into a square.
struct Charts {
    std::unique_ptr<xatlas::Atlas, Destroy> atlas;

    const xatlas::Mesh& mesh() const { return atlas->meshes[0]; }
};

}  // namespace

void bind_chart_ops(py::module_& m) {
    py::class_<Charts> charts(m, "Charts");
    def(charts, "count", "", [](const Charts& charts) {
        return std::make_tuple(charts.mesh().vertexCount, charts.mesh().indexCount / 3);
    });
    def(charts, "write", "source faces uv",
        [](const Charts& charts, Out<int64_t> source, Out<int32_t> faces, Out<float> uv) {
            const xatlas::Mesh& mesh = charts.mesh();
            require(source.size() == mesh.vertexCount && uv.size() == 2 * source.size() &&
                        faces.size() == mesh.indexCount,
                    "charts: source, faces and uv must be [Q], [F, 3] and [Q, 2]");
            for (int64_t i = 0; i < source.size(); ++i) {
                const xatlas::Vertex& vertex = mesh.vertexArray[i];
                source.mutable_data()[i] = vertex.xref;
                uv.mutable_data()[2 * i] = vertex.uv[0] / charts.atlas->width;
                uv.mutable_data()[2 * i + 1] = vertex.uv[1] / charts.atlas->height;
            }
            std::copy_n(mesh.indexArray, faces.size(), faces.mutable_data());
        });
    def(m, "find_charts", "vertices faces regions size padding",
        [](In<float> vertices, In<int32_t> faces, In<int32_t> regions, int size, int padding) {
            require(3 * regions.size() == faces.size(), "charts: regions must be [F]");
            Charts charts{std::unique_ptr<xatlas::Atlas, Destroy>(xatlas::Create())};
            xatlas::MeshDecl mesh;
            mesh.vertexPositionData = vertices.data();
            mesh.vertexPositionStride = 3 * sizeof(float);
            mesh.vertexCount = static_cast<uint32_t>(vertices.size() / 3);
            mesh.indexData = faces.data();  // a negative one is out of range as unsigned
            mesh.indexFormat = xatlas::IndexFormat::UInt32;
            mesh.indexCount = static_cast<uint32_t>(faces.size());
            mesh.faceMaterialData = reinterpret_cast<const uint32_t*>(regions.data());
            const xatlas::AddMeshError error = xatlas::AddMesh(charts.atlas.get(), mesh);
            require(error == xatlas::AddMeshError::Success,
                    std::string("charts: ") + xatlas::StringForEnum(error));
            xatlas::ChartOptions options;
            xatlas::PackOptions pack;
            // No mirrored charts, not every program can light them; the packer rotates by a
            // transposition.
            options.fixWinding = true, pack.rotateCharts = false;
            pack.resolution = size, pack.padding = padding, pack.bilinear = true;
            xatlas::Generate(charts.atlas.get(), options, pack);
            return charts;
        });
    def(m, "rasterise", "uv faces owner barycentric top",
        [](In<float> uv, In<int32_t> faces, Out<int32_t> owner, Out<float> barycentric,
           int64_t top) {
            const int64_t corners = uv.size() / 2;
            require(uv.ndim() == 2 && owner.ndim() == 2 && barycentric.size() == 2 * owner.size() &&
                        faces.size() % 3 == 0,
                    "rasterise: sizes do not fit");
            require(all_of<int32_t>(faces, [=](int32_t i) { return 0 <= i && i < corners; }),
                    "rasterise: faces must name corners that exist");
            rasterise(uv.data(), faces.data(), faces.size() / 3, owner.shape(1), top,
                      owner.shape(0), owner.mutable_data(), barycentric.mutable_data());
        });
    def(m, "sample_picture", "picture linear place colors threads",
        [](const std::variant<array<uint8_t>, array<float>>& picture, In<float> linear,
           In<float> place, Out<float> colors, int threads) {
            const int64_t n = place.size() / 2;
            require(place.size() == 2 * n && colors.size() == 3 * n && linear.size() == 256,
                    "sample_picture: sizes do not fit");
            std::visit(
                [&](const auto& a) {
                    require(a.ndim() == 3 && a.shape(2) == 3 && a.size() > 0,
                            "sample_picture: picture must be [H, W, 3]");
                    sample_picture(a.data(), a.shape(0), a.shape(1), linear.data(), place.data(), n,
                                   colors.mutable_data(), threads);
                },
                picture);
        });
    def(m, "add_photograph",
        "face barycentric corners shown values matrix mask linear picture total weights scale "
        "clipped of_clipped threads",
        [](In<int32_t> face, In<uint16_t> barycentric, In<int32_t> corners, In<uint8_t> shown,
           In<float> values, In<float> matrix, In<float> mask, In<float> linear,
           const std::variant<array<uint8_t>, array<float>>& picture, Out<float> total,
           Out<float> weights, float scale, float clipped, float of_clipped, int threads) {
            const int64_t k = face.size(), f = shown.size(), p = values.shape(0);
            require(barycentric.size() == 2 * k && corners.size() == 3 * f &&
                        values.size() == 13 * p && matrix.size() == 12 && mask.ndim() == 2 &&
                        mask.size() > 0 && linear.size() == 256 && total.size() == 3 * k &&
                        weights.size() == k,
                    "add_photograph: sizes do not fit");
            const auto below = [](int64_t n) { return [n](int32_t i) { return 0 <= i && i < n; }; };
            require(all_of<int32_t>(face, below(f)) && all_of<int32_t>(corners, below(p)),
                    "add_photograph: face and corners must name rows that exist");
            std::visit(
                [&](const auto& a) {
                    require(a.ndim() == 3 && a.shape(2) == 3 && a.size() > 0,
                            "add_photograph: picture must be [H, W, 3]");
                    const auto in =
                        make<Texels>(face, barycentric, corners, shown, values, matrix, mask,
                                     linear, k, a.shape(0), a.shape(1), mask.shape(0),
                                     mask.shape(1), scale, clipped, of_clipped);
                    add_photograph(in, a.data(), total.mutable_data(), weights.mutable_data(),
                                   threads);
                },
                picture);
        });
}

}  // namespace univoxel
