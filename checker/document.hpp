// The document, the model and the law (format page, sections 2 to 4).
#pragma once
#include "enclosure.hpp"
#include "text.hpp"

// ---- The grammar -----------------------------------------------------------------------------------

inline const Json& of_kind(const Json& j, Json::Kind kind, const char* what) {
    if (j.kind != kind) refuse(std::string(what) + " has the wrong type");
    return j;
}
inline void only_keys(const Json& j, std::vector<std::string> keys, const char* what, bool hint = false) {
    of_kind(j, Json::object, what);
    for (const std::string& key : keys)
        if (!j.keys.count(key)) refuse(std::string(what) + " lacks the key " + key);
    size_t most = keys.size();
    if (hint && j.keys.count("hint")) {
        of_kind(j.keys.at("hint"), Json::object, "hint");
        ++most;
    }
    if (j.keys.size() != most) refuse(std::string(what) + " has a key that the format does not know");
}
inline const std::vector<Json>& list(const Json& j, size_t least, size_t most, const char* what) {
    of_kind(j, Json::list, what);
    if (j.items.size() < least || j.items.size() > most)
        refuse(std::string(what) + " has a wrong number of entries");
    return j.items;
}
inline size_t index_below(const Json& j, size_t limit, const char* what) {
    if (of_kind(j, Json::whole, what).number >= int64_t(limit)) refuse(std::string(what) + ": index too large");
    return size_t(j.number);
}
inline std::string label(const Json& j, size_t most, const char* what) {
    if (characters(of_kind(j, Json::text, what).string) > most) refuse(std::string(what) + " is too long");
    return j.string;
}
inline std::string name(const std::string& s) {
    bool fine = !s.empty() && s.size() <= 64 && !(s[0] >= '0' && s[0] <= '9');
    for (char c : s)
        fine &= (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_';
    if (!fine) refuse("a name is none (letters of ASCII, digits, underscores, 1 to 64)");
    return s;
}
inline Fraction fraction(const Json& j, int least_sign = -1) {  // 0: not negative, 1: positive
    const Fraction x = number_text(of_kind(j, Json::text, "a number").string);
    if (x.sign() < least_sign) refuse(least_sign ? "a number must be > 0" : "a number must be >= 0");
    return x;
}
inline std::vector<Fraction> fractions(const Json& j, size_t count, const char* what, int least_sign = -1) {
    std::vector<Fraction> r;
    for (const Json& item : list(j, count, count, what)) r.push_back(fraction(item, least_sign));
    return r;
}
inline Matrix<Fraction> fraction_matrix(const Json& j, size_t rows, size_t columns, const char* what) {
    Matrix<Fraction> r;
    for (const Json& row : list(j, rows, rows, what)) r.push_back(fractions(row, columns, what));
    return r;
}

// ---- The model -------------------------------------------------------------------------------------

enum class Op { number, pi, position, velocity, parameter, add, sub, mul, div, neg, pow, sqrt, sin, cos, tanh, exp, log };

struct Node {
    Op op;
    size_t a = 0, b = 0;
    Fraction value;
};

inline std::vector<Node> read_nodes(const Json& j, size_t n, size_t parameters) {
    static const std::map<std::string, Op> known = {
        {"number", Op::number}, {"pi", Op::pi}, {"position", Op::position}, {"velocity", Op::velocity},
        {"parameter", Op::parameter}, {"add", Op::add}, {"sub", Op::sub}, {"mul", Op::mul},
        {"div", Op::div}, {"neg", Op::neg}, {"pow", Op::pow}, {"sqrt", Op::sqrt}, {"sin", Op::sin},
        {"cos", Op::cos}, {"tanh", Op::tanh}, {"exp", Op::exp}, {"log", Op::log}};
    std::vector<Node> nodes;
    for (const Json& item : list(j, 1, 20000, "nodes")) {
        const auto& parts = list(item, 1, 3, "node");
        const auto found = known.find(of_kind(parts[0], Json::text, "kind of node").string);
        if (found == known.end()) refuse("a node of an unknown kind");
        Node node{found->second, 0, 0, 0};
        const bool two = node.op >= Op::add && node.op <= Op::div;
        list(item, node.op == Op::pi ? 1 : two || node.op == Op::pow ? 3 : 2,
             node.op == Op::pi ? 1 : two || node.op == Op::pow ? 3 : 2, "node");
        if (node.op == Op::number) node.value = fraction(parts[1]);
        else if (node.op == Op::position || node.op == Op::velocity) node.a = index_below(parts[1], n, "coordinate");
        else if (node.op == Op::parameter) node.a = index_below(parts[1], parameters, "parameter");
        else if (node.op != Op::pi) {
            node.a = index_below(parts[1], nodes.size(), "operand");
            if (two) node.b = index_below(parts[2], nodes.size(), "operand");
            if (node.op == Op::pow) {
                node.b = index_below(parts[2], 65, "exponent");
                if (node.b < 2) refuse("an exponent below 2");
            }
        }
        nodes.push_back(node);
    }
    return nodes;
}
inline bool has_operands(Op op) { return op >= Op::add; }
inline bool has_two(Op op) { return op >= Op::add && op <= Op::div; }

// Values of the nodes that are numbers or parameters.
template <class T>
std::vector<Jet<T>> leaves_of(const std::vector<Node>& nodes, const std::vector<bool>& needed,
                              const std::vector<Fraction>& parameters) {
    std::vector<Jet<T>> r(nodes.size());
    for (size_t i = 0; i < nodes.size(); ++i) {
        if (!needed[i]) continue;
        if (nodes[i].op == Op::number) r[i] = Jet<T>(T::constant(nodes[i].value));
        if (nodes[i].op == Op::parameter) r[i] = Jet<T>(T::constant(parameters[nodes[i].a]));
        if (nodes[i].op == Op::pi) r[i] = Jet<T>(T::pi());
    }
    return r;
}
// Values of the nodes that are needed, at positions q and velocities v, from those of the leaves.
template <class T>
std::vector<Jet<T>> evaluate(const std::vector<Node>& nodes, const std::vector<bool>& needed,
                             std::vector<Jet<T>> r, const std::vector<Jet<T>>& q,
                             const std::vector<Jet<T>>& v) {
    for (size_t i = 0; i < nodes.size(); ++i) {
        if (!needed[i]) continue;
        const Node& node = nodes[i];
        const Jet<T>&a = r[has_operands(node.op) ? node.a : 0], &b = r[has_two(node.op) ? node.b : 0];
        switch (node.op) {
        case Op::number: case Op::pi: case Op::parameter: break;
        case Op::position: r[i] = q[node.a]; break;
        case Op::velocity: r[i] = v[node.a]; break;
        case Op::add: r[i] = a + b; break;
        case Op::sub: r[i] = a - b; break;
        case Op::mul: r[i] = a * b; break;
        case Op::div: r[i] = a / b; break;
        case Op::neg: r[i] = -a; break;
        case Op::pow: r[i] = power(a, int(node.b)); break;
        case Op::sqrt: r[i] = root(a); break;
        case Op::sin: r[i] = wave(a, 0); break;
        case Op::cos: r[i] = wave(a, 1); break;
        case Op::tanh: r[i] = tanh_of(a); break;
        case Op::exp: r[i] = exponential(a); break;
        case Op::log: r[i] = logarithm(a); break;
        }
    }
    return r;
}
inline std::vector<bool> needed_for(const std::vector<Node>& nodes, const std::vector<size_t>& roots) {
    std::vector<bool> needed(nodes.size(), false);
    for (size_t root : roots) needed[root] = true;
    for (size_t i = nodes.size(); i-- > 0;)
        if (needed[i] && has_operands(nodes[i].op)) {
            needed[nodes[i].a] = true;
            if (has_two(nodes[i].op)) needed[nodes[i].b] = true;
        }
    return needed;
}

template <class T> struct Plant {
    Matrix<Jet<T>> M, B;
    std::vector<Jet<T>> f;
};

struct Model {
    size_t n = 0, m = 0;
    std::vector<std::string> positions, inputs, parameter_names;
    std::vector<bool> limited;
    std::vector<Fraction> limits, parameters;
    std::vector<Node> nodes;
    Matrix<size_t> M, B;
    std::vector<size_t> f;
    std::vector<bool> geometry, needed;  // nodes of M and B; nodes of all

    explicit Model(const Json& j) {
        only_keys(j, {"name", "positions", "inputs", "parameters", "nodes", "M", "f", "B"}, "model");
        label(j.keys.at("name"), 64, "name of the model");
        std::set<std::string> names;
        const auto fresh = [&](const std::string& s) {
            if (!names.insert(s).second) refuse("a name occurs twice");
        };
        for (const Json& item : list(j.keys.at("positions"), 2, 12, "positions")) {
            only_keys(item, {"name", "unit"}, "position");
            positions.push_back(name(of_kind(item.keys.at("name"), Json::text, "name").string));
            label(item.keys.at("unit"), 16, "unit");
            fresh(positions.back());
            fresh(positions.back() + "_dot");
        }
        n = positions.size();
        for (const Json& item : list(j.keys.at("inputs"), 1, n - 1, "inputs")) {
            only_keys(item, {"name", "unit", "limit"}, "input");
            inputs.push_back(name(of_kind(item.keys.at("name"), Json::text, "name").string));
            label(item.keys.at("unit"), 16, "unit");
            const Json& limit = item.keys.at("limit");
            limited.push_back(limit.kind != Json::null);
            limits.push_back(limited.back() ? fraction(limit, 1) : Fraction(0));
        }
        m = inputs.size();
        for (const Json& item : list(j.keys.at("parameters"), 0, 200, "parameters")) {
            only_keys(item, {"name", "unit", "value"}, "parameter");
            parameter_names.push_back(name(of_kind(item.keys.at("name"), Json::text, "name").string));
            fresh(parameter_names.back());
            label(item.keys.at("unit"), 16, "unit");
            parameters.push_back(fraction(item.keys.at("value")));
        }
        nodes = read_nodes(j.keys.at("nodes"), n, parameters.size());
        const auto indices = [&](const Json& row, size_t count, const char* what) {
            std::vector<size_t> r;
            for (const Json& k : list(row, count, count, what)) r.push_back(index_below(k, nodes.size(), what));
            return r;
        };
        std::vector<size_t> roots;
        const auto& rows = list(j.keys.at("M"), n, n, "M");
        for (size_t i = 0; i < n; ++i) {
            M.push_back(indices(rows[i], i + 1, "M"));
            roots.insert(roots.end(), M[i].begin(), M[i].end());
        }
        for (const Json& row : list(j.keys.at("B"), m, m, "B")) {
            B.push_back(indices(row, m, "B"));
            roots.insert(roots.end(), B.back().begin(), B.back().end());
        }
        f = indices(j.keys.at("f"), n, "f");
        geometry = needed_for(nodes, roots);
        for (size_t i = 0; i < nodes.size(); ++i)
            if (geometry[i] && nodes[i].op == Op::velocity) refuse("M or B depends on a velocity");
        roots.insert(roots.end(), f.begin(), f.end());
        needed = needed_for(nodes, roots);
    }

    template <class T>
    Plant<T> at(const std::vector<Jet<T>>& q, const std::vector<Jet<T>>& v, bool with_f = true,
                const std::vector<Jet<T>>* leaves = nullptr) const {
        const auto& wanted = with_f ? needed : geometry;
        const auto value = evaluate<T>(nodes, wanted, leaves ? *leaves : leaves_of<T>(nodes, wanted, parameters), q, v);
        Plant<T> p;
        p.M.assign(n, std::vector<Jet<T>>(n));
        for (size_t i = 0; i < n; ++i)
            for (size_t j = 0; j <= i; ++j) p.M[i][j] = p.M[j][i] = value[M[i][j]];
        for (const auto& row : B) {
            p.B.emplace_back();
            for (size_t k : row) p.B.back().push_back(value[k]);
        }
        if (with_f)
            for (size_t k : f) p.f.push_back(value[k]);
        return p;
    }
};

// ---- The law ---------------------------------------------------------------------------------------

struct Law {
    Matrix<Fraction> alpha_a, lambda_a, alpha_u, lambda_u;
    std::vector<Fraction> eta, layer, disturbance;
    std::string switching;
    bool robust = false;  // K grows with a disturbance

    Law(const Json& j, const Model& model) {
        const size_t n = model.n, m = model.m;
        only_keys(j, {"alpha_a", "lambda_a", "alpha_u", "lambda_u", "eta", "layer", "switching", "disturbance"}, "law");
        alpha_a = fraction_matrix(j.keys.at("alpha_a"), m, m, "alpha_a");
        lambda_a = fraction_matrix(j.keys.at("lambda_a"), m, m, "lambda_a");
        alpha_u = fraction_matrix(j.keys.at("alpha_u"), m, n - m, "alpha_u");
        lambda_u = fraction_matrix(j.keys.at("lambda_u"), m, n - m, "lambda_u");
        eta = fractions(j.keys.at("eta"), m, "eta", 1);
        layer = fractions(j.keys.at("layer"), m, "layer", 1);
        switching = of_kind(j.keys.at("switching"), Json::text, "switching").string;
        if (switching != "saturation" && switching != "tanh" && switching != "sign")
            refuse("an unknown switching");
        disturbance = fractions(j.keys.at("disturbance"), n, "disturbance", 0);
        for (const Fraction& g : disturbance) robust |= g.sign() > 0;
    }
};

template <class T> Matrix<Jet<T>> constants(const Matrix<Fraction>& a) {
    Matrix<Jet<T>> r;
    for (const auto& row : a) {
        r.emplace_back();
        for (const Fraction& x : row) r.back().push_back(Jet<T>(T::constant(x)));
    }
    return r;
}

// M = L D Lᵀ, the unactuated positions first, and what section 4 makes of it.
template <class T> struct Geometry {
    using J = Jet<T>;
    size_t n, m, u;
    Matrix<J> L;
    std::vector<J> pivots;
    Matrix<J> X, S, gamma;
    J det_gamma, det_B;

    Geometry(const Model& model, const Law& law, const Plant<T>& p) : n(model.n), m(model.m), u(n - m) {
        const auto place = [&](size_t i) { return i < u ? m + i : i - u; };
        L.assign(n, std::vector<J>(n));
        Matrix<J> R(n, std::vector<J>(n));
        for (size_t i = 0; i < n; ++i)
            for (size_t j = 0; j < n; ++j) R[i][j] = p.M[place(i)][place(j)];
        for (size_t k = 0; k < n; ++k) {
            if (k == u) {
                S.assign(m, std::vector<J>(m));
                for (size_t i = 0; i < m; ++i)
                    for (size_t j = 0; j < m; ++j) S[i][j] = R[u + i][u + j];
            }
            pivots.push_back(R[k][k]);
            L[k][k] = J(T(1.0));
            for (size_t i = k + 1; i < n; ++i) L[i][k] = R[i][k] / R[k][k];
            for (size_t i = k + 1; i < n; ++i)
                for (size_t j = k + 1; j <= i; ++j) R[i][j] = R[j][i] = R[i][j] - L[i][k] * R[j][k];
        }
        X.assign(u, std::vector<J>(m));
        for (size_t j = 0; j < m; ++j) {
            std::vector<J> column;
            for (size_t i = 0; i < u; ++i) column.push_back(p.M[m + i][j]);
            column = solve(column, 0, u);
            for (size_t i = 0; i < u; ++i) X[i][j] = column[i];
        }
        gamma = sum(constants<T>(law.alpha_a), product(constants<T>(law.alpha_u), X), true);
        det_gamma = determinant(gamma);
        det_B = determinant(p.B);
    }
    // the block from..to of the factors: M_uu (0, u), S (u, n) or all of M
    std::vector<J> solve(std::vector<J> x, size_t from, size_t to) const {
        const size_t count = to - from;
        for (size_t i = 0; i < count; ++i)
            for (size_t k = 0; k < i; ++k) x[i] = x[i] - L[from + i][from + k] * x[k];
        for (size_t i = 0; i < count; ++i) x[i] = x[i] / pivots[from + i];
        for (size_t i = count; i-- > 0;)
            for (size_t k = i + 1; k < count; ++k) x[i] = x[i] - L[from + k][from + i] * x[k];
        return x;
    }
    Matrix<J> block_inverse(size_t from, size_t to) const {  // symmetric
        Matrix<J> r;
        for (size_t k = 0; k < to - from; ++k) {
            std::vector<J> e(to - from);
            e[k] = J(T(1.0));
            r.push_back(solve(e, from, to));
        }
        return r;
    }
    std::vector<J> gains(const Law& law) const {
        std::vector<J> k;
        for (const Fraction& x : law.eta) k.push_back(J(T::constant(x)));
        if (!law.robust) return k;
        const auto sizes = [](Matrix<J> a) {
            for (auto& row : a)
                for (J& x : row) x = size_of(x);
            return a;
        };
        const auto vector = [](const std::vector<Fraction>& x, size_t from, size_t to) {
            std::vector<J> r;
            for (size_t i = from; i < to; ++i) r.push_back(J(T::constant(x[i])));
            return r;
        };
        const auto plus = [](std::vector<J> x, const std::vector<J>& y) {
            for (size_t i = 0; i < x.size(); ++i) x[i] = x[i] + y[i];
            return x;
        };
        const auto most = [](const std::vector<J>& x) {
            J r = x[0];
            for (size_t i = 1; i < x.size(); ++i) r = larger(r, x[i]);
            return r;
        };
        const auto ga = vector(law.disturbance, 0, m), gu = vector(law.disturbance, m, n);
        const auto X1 = sizes(X);
        const auto a = product(sizes(block_inverse(u, n)), plus(ga, product(transposed(X1), gu)));
        const auto b = plus(product(sizes(block_inverse(0, u)), gu), product(X1, a));
        const J worst_a = most(a), worst_b = most(b);
        const auto A = sizes(constants<T>(law.alpha_a)), U = sizes(constants<T>(law.alpha_u));
        for (size_t i = 0; i < m; ++i) {
            J of_a, of_u;
            for (const J& x : A[i]) of_a = of_a + x;
            for (const J& x : U[i]) of_u = of_u + x;
            k[i] = k[i] + of_a * worst_a + of_u * worst_b;
        }
        return k;
    }
    // W = [α_a α_u] M⁻¹, the columns as the positions are numbered
    Matrix<J> force_rows(const Law& law) const {
        const auto A = constants<T>(law.alpha_a), U = constants<T>(law.alpha_u);
        Matrix<J> r;
        for (size_t i = 0; i < m; ++i) {
            std::vector<J> row(U[i]);
            row.insert(row.end(), A[i].begin(), A[i].end());
            row = solve(row, 0, n);
            std::rotate(row.begin(), row.begin() + long(u), row.end());
            r.push_back(row);
        }
        return r;
    }
};
