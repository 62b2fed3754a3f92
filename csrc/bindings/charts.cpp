#include <xatlas.h>

#include <memory>

#include "bindings/common.h"

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
    def(m, "find_charts", "vertices faces size padding",
        [](In<float> vertices, In<int32_t> faces, int size, int padding) {
            Charts charts{std::unique_ptr<xatlas::Atlas, Destroy>(xatlas::Create())};
            xatlas::MeshDecl mesh;
            mesh.vertexPositionData = vertices.data();
            mesh.vertexPositionStride = 3 * sizeof(float);
            mesh.vertexCount = static_cast<uint32_t>(vertices.size() / 3);
            mesh.indexData = faces.data();  // a negative one is out of range as unsigned
            mesh.indexFormat = xatlas::IndexFormat::UInt32;
            mesh.indexCount = static_cast<uint32_t>(faces.size());
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
}

}  // namespace univoxel
