// A reconstruction core as a command, in one file of C++17 without dependencies:
// the axis of the cone of sightlines through the isophote at half of the peak.
//
//   g++ -O2 -std=c++17 -o core core.cpp
//   simtest core check ./core
//
// To make your own, keep the rest and replace `estimate`. docs/reference/cores.md describes the protocol.
// It runs on little-endian machines, as the protocol's arrays are.

#include <array>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <iostream>
#include <map>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

using Vector = std::array<double, 3>;
using Matrix = std::array<Vector, 3>;

// ---------------------------------------------------------------- JSON: what a request's header holds

struct Json {
    enum Kind { Null, Boolean, Number, String, List, Object } kind = Null;
    double number = 0;  // of a boolean too
    std::string text;
    std::vector<Json> list;
    std::map<std::string, Json> object;

    const Json& operator[](const std::string& key) const {
        static const Json null;
        auto found = object.find(key);
        return found == object.end() ? null : found->second;
    }
};

class Parser {
    const std::string& s;
    size_t i = 0;

    char next() {
        while (i < s.size() && std::strchr(" \t\r\n", s[i])) ++i;
        if (i >= s.size()) throw std::runtime_error("the header ends too early");
        return s[i];
    }
    void expect(char c) {
        if (next() != c) throw std::runtime_error(std::string("the header lacks a ") + c);
        ++i;
    }
    std::string string() {
        std::string out;
        expect('"');
        while (i < s.size() && s[i] != '"') {
            if (s[i] == '\\' && ++i < s.size()) {
                if (s[i] == 'u') {  // no name that this core needs holds one
                    out += '?';
                    i += 5;
                    continue;
                }
                const char* from = "nrtbf";
                const char* to = "\n\r\t\b\f";
                const char* at = std::strchr(from, s[i]);
                out += at && *at ? to[at - from] : s[i];
            } else {
                out += s[i];
            }
            ++i;
        }
        expect('"');
        return out;
    }

public:
    explicit Parser(const std::string& text) : s(text) {}

    Json value() {
        Json made;
        char c = next();
        if (c == '{') {
            made.kind = Json::Object;
            for (++i; next() != '}';) {
                std::string key = string();
                expect(':');
                made.object[key] = value();
                if (next() == ',') ++i;
            }
            ++i;
        } else if (c == '[') {
            made.kind = Json::List;
            for (++i; next() != ']';) {
                made.list.push_back(value());
                if (next() == ',') ++i;
            }
            ++i;
        } else if (c == '"') {
            made.kind = Json::String;
            made.text = string();
        } else if (c == 't' || c == 'f' || c == 'n') {
            made.kind = c == 'n' ? Json::Null : Json::Boolean;
            made.number = c == 't';
            i += c == 'f' ? 5 : 4;
        } else {
            made.kind = Json::Number;
            char* end = nullptr;
            made.number = std::strtod(s.c_str() + i, &end);
            if (end == s.c_str() + i) throw std::runtime_error("the header is no JSON");
            i = end - s.c_str();
        }
        return made;
    }
};

// ---------------------------------------------------------------- small linear algebra

double dot(const Vector& a, const Vector& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

Vector scaled(const Vector& a, double factor) { return {a[0] * factor, a[1] * factor, a[2] * factor}; }

// Solve A x = b of 5 unknowns by Gaussian elimination with pivots; false where A is singular.
bool solve(double A[5][5], double b[5], double x[5]) {
    for (int k = 0; k < 5; ++k) {
        int pivot = k;
        for (int r = k + 1; r < 5; ++r)
            if (std::fabs(A[r][k]) > std::fabs(A[pivot][k])) pivot = r;
        if (A[pivot][k] == 0) return false;
        for (int c = 0; c < 5; ++c) std::swap(A[k][c], A[pivot][c]);
        std::swap(b[k], b[pivot]);
        for (int r = k + 1; r < 5; ++r) {
            double share = A[r][k] / A[k][k];
            for (int c = k; c < 5; ++c) A[r][c] -= share * A[k][c];
            b[r] -= share * b[k];
        }
    }
    for (int k = 4; k >= 0; --k) {
        x[k] = b[k];
        for (int c = k + 1; c < 5; ++c) x[k] -= A[k][c] * x[c];
        x[k] /= A[k][k];
    }
    return true;
}

// Eigenvalues, upwards, and eigenvectors, as rows, of a symmetric matrix, by Jacobi's rotations.
void eigen(Matrix A, Vector& values, Matrix& vectors) {
    Matrix V = {{{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}};  // columns
    for (int sweep = 0; sweep < 50; ++sweep) {
        double off = std::fabs(A[0][1]) + std::fabs(A[0][2]) + std::fabs(A[1][2]);
        if (off == 0) break;
        for (int p = 0; p < 2; ++p)
            for (int q = p + 1; q < 3; ++q) {
                if (A[p][q] == 0) continue;
                double theta = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                double t = (theta >= 0 ? 1 : -1) / (std::fabs(theta) + std::sqrt(theta * theta + 1));
                double c = 1 / std::sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 3; ++k) {
                    double a = A[k][p], b = A[k][q];
                    A[k][p] = c * a - s * b;
                    A[k][q] = s * a + c * b;
                }
                for (int k = 0; k < 3; ++k) {
                    double a = A[p][k], b = A[q][k];
                    A[p][k] = c * a - s * b;
                    A[q][k] = s * a + c * b;
                }
                A[p][q] = A[q][p] = 0;
                for (int k = 0; k < 3; ++k) {
                    double a = V[k][p], b = V[k][q];
                    V[k][p] = c * a - s * b;
                    V[k][q] = s * a + c * b;
                }
            }
    }
    int order[3] = {0, 1, 2};
    for (int a = 0; a < 2; ++a)
        for (int b = a + 1; b < 3; ++b)
            if (A[order[b]][order[b]] < A[order[a]][order[a]]) std::swap(order[a], order[b]);
    for (int k = 0; k < 3; ++k) {
        values[k] = A[order[k]][order[k]];
        for (int j = 0; j < 3; ++j) vectors[k][j] = V[j][order[k]];
    }
}

// ---------------------------------------------------------------- the method

std::string failure(const std::string& id, const char* reason, const std::string& detail) {
    return "{\"type\":\"failure\",\"id\":" + id + ",\"reason\":\"" + reason + "\",\"detail\":\"" + detail + "\"}";
}

// The answer, as JSON, to the rays of an isophote; none where there is no closed one.
std::string estimate(std::vector<Vector> rays, const std::string& id) {
    if (rays.empty()) return failure(id, "no_closed_isophote", "the isophote was not sent");
    if (rays.front() == rays.back()) rays.pop_back();  // the polygon is closed; its first point counts once
    if (rays.size() < 6)
        return failure(id, "too_few_points", std::to_string(rays.size()) + " points; at least 6 are needed");
    const double count = static_cast<double>(rays.size());

    // a gnomonic plane across the middle of the rays, centred and scaled so that the fit is well conditioned
    Vector middle = {0, 0, 0};
    for (const Vector& ray : rays)
        for (int k = 0; k < 3; ++k) middle[k] += ray[k];
    middle = scaled(middle, 1 / std::sqrt(dot(middle, middle)));
    const double sign = middle[2] >= 0 ? 1 : -1, a = -1 / (sign + middle[2]), b = middle[0] * middle[1] * a;
    const Vector right = {1 + sign * middle[0] * middle[0] * a, sign * b, -sign * middle[0]};
    const Vector down = {b, sign + middle[1] * middle[1] * a, -middle[1]};
    std::vector<double> x, y;
    double cx = 0, cy = 0, scale = 0;
    for (const Vector& ray : rays) {
        x.push_back(dot(ray, right) / dot(ray, middle));
        y.push_back(dot(ray, down) / dot(ray, middle));
        cx += x.back() / count;
        cy += y.back() / count;
    }
    for (size_t i = 0; i < x.size(); ++i) scale += ((x[i] - cx) * (x[i] - cx) + (y[i] - cy) * (y[i] - cy)) / count;
    scale = std::sqrt(scale);

    // the ellipse (1 + p) x^2 + 2 q x y + (1 - p) y^2 + d x + e y + f = 0, by least squares
    double normal_matrix[5][5] = {}, right_side[5] = {}, s[5], xx = 0, xy = 0, yy = 0;
    for (size_t i = 0; i < x.size(); ++i) {
        const double u = (x[i] - cx) / scale, v = (y[i] - cy) / scale;
        const double row[5] = {u * u - v * v, 2 * u * v, u, v, 1};
        xx += u * u / count, xy += u * v / count, yy += v * v / count;
        for (int r = 0; r < 5; ++r) {
            for (int c = 0; c < 5; ++c) normal_matrix[r][c] += row[r] * row[c];
            right_side[r] -= row[r] * (u * u + v * v);
        }
    }
    if (!(xx * yy - xy * xy >= 1e-9)) return failure(id, "degenerate_conic", "the points lie on a line");
    if (!solve(normal_matrix, right_side, s)) return failure(id, "degenerate_conic", "the points determine no ellipse");
    if (!(s[0] * s[0] + s[1] * s[1] < 1)) return failure(id, "not_an_ellipse", "the fitted conic is no ellipse");
    const Matrix conic = {{{1 + s[0], s[1], s[2] / 2}, {s[1], 1 - s[0], s[3] / 2}, {s[2] / 2, s[3] / 2, s[4]}}};

    // the cone w^T C w = 0 of camera directions w, and its axis: the eigenvector of the one negative eigenvalue
    Matrix plane, cone = {};
    for (int k = 0; k < 3; ++k)
        plane[0][k] = (right[k] - cx * middle[k]) / scale, plane[1][k] = (down[k] - cy * middle[k]) / scale,
        plane[2][k] = middle[k];
    for (int r = 0; r < 3; ++r)
        for (int c = 0; c < 3; ++c)
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j) cone[r][c] += plane[i][r] * conic[i][j] * plane[j][c];
    Vector values;
    Matrix vectors;
    eigen(cone, values, vectors);
    if (!(values[0] < 0 && 0 < values[1])) return failure(id, "degenerate_conic", "the conic is no cone of an ellipse");
    const Vector axis = scaled(vectors[0], dot(vectors[0], middle) > 0 ? 1 : -1);
    // A light at the camera: where the normal points back along the sightline, the reflection is brightest.
    char text[512];
    std::snprintf(text, sizeof text,
                  "{\"type\":\"estimate\",\"id\":%s,\"normal\":[%.17g,%.17g,%.17g],"
                  "\"look_ray\":[%.17g,%.17g,%.17g],\"axis_ratio\":%.17g}",
                  id.c_str(), -axis[0], -axis[1], -axis[2], axis[0], axis[1], axis[2], std::sqrt(values[1] / values[2]));
    return text;
}

// ---------------------------------------------------------------- the protocol

size_t item_size(const std::string& dtype) { return dtype.back() - '0'; }  // "<f8" has 8 bytes

int main() {
    std::ios::sync_with_stdio(false);
    std::string line;
    while (std::getline(std::cin, line)) {
        const Json header = Parser(line).value();
        if (header["type"].text == "hello") {
            std::cout << "{\"type\":\"hello\",\"protocol\":1,\"name\":\"cone_axis_cpp\",\"version\":\"1.0\","
                         "\"kind\":\"patch\",\"arrays\":[\"isophote_rays_0.5\"],\"isophotes\":[0.5]}"
                      << std::endl;
            continue;
        }
        std::vector<Vector> rays;
        for (const Json& entry : header["arrays"].list) {
            size_t count = 1;
            for (const Json& size : entry["shape"].list) count *= static_cast<size_t>(size.number);
            std::vector<char> content(count * item_size(entry["dtype"].text));
            std::cin.read(content.data(), static_cast<std::streamsize>(content.size()));
            if (entry["name"].text == "isophote_rays_0.5" && entry["dtype"].text == "<f8") {
                rays.resize(count / 3);
                std::memcpy(rays.data(), content.data(), content.size());
            }
        }
        std::cout << estimate(rays, std::to_string(static_cast<long long>(header["id"].number))) << std::endl;
    }
}
